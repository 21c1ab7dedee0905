"""Identification with nuisance parameters: what the installation adds, estimated beside faults."""
