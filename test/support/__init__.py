"""What the tests share."""

from pathlib import Path

ROOT = Path(__file__).parents[2]  # of the checkout; processes that run `-m test.support.X` start here
CONFIG = ROOT / "config"
DATA = ROOT / "test" / "data"
