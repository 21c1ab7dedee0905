"""Reads recordings of decoded signals (a data-acquisition system): names, tables, ticks."""
