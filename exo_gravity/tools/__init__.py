"""Command-line tools: one file per command, one folder per family of helpers."""
