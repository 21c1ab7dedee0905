"""The package's front door in Python: read, simulate, diagnose; `import ehadiag` offers it all.

Like the command line, and unlike what lies below it, the facade knows bus and simulator.
"""
