"""Command-line tools of the developers: tables, sweeps, benchmarks, figures."""
