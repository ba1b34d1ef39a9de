"""Base of every table of settings, and what each key means, in words for the operator."""
