"""Accuracy of the identification on tests with known truth."""
