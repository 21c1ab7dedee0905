"""Developers' tools: the paper's tables, accuracy sweeps, benchmarks, soaks."""
