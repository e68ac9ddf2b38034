"""Troubleshooting quotes messages and fault codes that the code has."""

import re
from pathlib import Path

import pytest

from exo_gravity.core.safety.drive import FaultCode

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
# Adjacent string literals, as the formatter splits long messages, become one.
SOURCE = "\n".join(
    re.sub(r'"\s*\n\s*f?"', "", path.read_text(encoding="utf-8")) for path in sorted(ROOT.glob("exo_gravity/**/*.py"))
)


def quoted(heading: str) -> list[str]:
    """Return what is in backticks in the first column of the tables with this heading."""
    tables = re.findall(rf"\| {heading} \|.*\n\|[-|]+\n((?:\|.*\n)+)", TEXT)
    return [
        code for table in tables for line in table.splitlines() for code in re.findall("`([^`]+)`", line.split("|")[1])
    ]


@pytest.mark.parametrize("message", quoted("message"))
def test_a_quoted_message_is_in_the_code(message: str) -> None:
    assert message in SOURCE or message in set(FaultCode)


def test_every_fault_code_that_is_explained_exists() -> None:
    assert len(quoted("fault")) > 5
    assert set(quoted("fault")) <= set(FaultCode)
