"""Command-line parts that the tools share: argument types, and messages about packages that are not installed."""
