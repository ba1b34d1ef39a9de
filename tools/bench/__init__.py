"""Benchmarks: the service beside other Python loops, senders and filters, measured in one run. See ``run.py``."""
