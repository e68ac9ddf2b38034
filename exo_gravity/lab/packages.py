"""What is said of a Python package that is not installed: by which extra of this package it comes."""

# Ubuntu 24.04 has these as python3-NAME; all others come from PyPI only.
APT = ("matplotlib", "rich", "scipy", "sklearn", "threadpoolctl", "yaml")


def missing(module: str, extra: str) -> str:
    """Return a sentence that names the missing `module` and how to install it; extra: e.g. 'report'."""
    module = module.partition(".")[0]
    apt = f"apt install python3-{module}, or " if module in APT else ""
    return f"the Python package {module} is not installed: {apt}pip install 'exo_gravity[{extra}]'"
