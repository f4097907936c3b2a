"""Benchmarks of the policies in the twin: suites, trials, tables and the results page."""
