"""The subcommands of `ehadiag`, one module each."""
