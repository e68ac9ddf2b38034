# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What a recording is of: the subject's code, the protocol and a note. No name of a person belongs in any of them."""

import re
from dataclasses import dataclass
from datetime import date
from typing import Any

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.params import check_owned, owned

SUBJECT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,31}")  # a folder's name on every file system
LONGEST = 1000  # characters of a text


@dataclass(frozen=True)
class Session:
    """The subject and the purpose of a recording. Raises ParameterError, which names the field."""

    subject: str = owned("", "code of the subject, such as P01; no name")
    protocol: str = owned("", "protocol that is followed")
    note: str = owned("", "note on the session; no name")
    version: str = ""  #: of the package that recorded; '' if it is not known

    def __post_init__(self) -> None:
        check_owned(self)
        if self.subject and not SUBJECT.fullmatch(self.subject):
            expected = "a code of at most 32 letters A-Z, digits, - and _, such as P01: it names a folder"
            raise ParameterError("subject", self.subject, expected)
        for name in ("protocol", "note"):
            check_text(name, getattr(self, name))

    def folder(self, day: date) -> str:
        """Return the folder of the subject's recordings of a day, below all others: 'P01/2026-03-14'."""
        return f"{self.subject}/{day:%Y-%m-%d}" if self.subject else ""


def check_text(name: str, text: Any) -> str:
    """Return `text`; raise ParameterError unless it is a text of at most 1000 characters.

    A browser's field may cut an emoji in half. The half (a lone surrogate) cannot be encoded, so it is refused.
    """
    if not isinstance(text, str) or len(text) > LONGEST or "\0" in text or re.search("[\ud800-\udfff]", text):
        raise ParameterError(name, text, f"a text of at most {LONGEST} whole characters")
    return text
