"""Lets the tests of the tools import what is made beside them."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
