"""What a page may ask for: each request is checked here before anything is done.

{"do": "let_down"}                                   all arms; every page may, at any time
{"do": "let_down", "arm": "right"}                   one arm
{"do": "enable", "arm": "right"}                     the rest: only the page that holds control
{"do": "clear_fault", "arm": "right"}
{"do": "set", "arm": "right", "values": {"support": 0.3}}
{"do": "take"}, {"do": "release"}                    control; take: every page
{"do": "record"}, {"do": "stop_recording"}, {"do": "save"}
{"do": "trial", "name": "demo"}, {"do": "stop_trial"}
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from exo_gravity.core.errors import ParameterError
from exo_gravity.panel.params import SETTABLE

OF_ONE_ARM = ("enable", "clear_fault", "set")
PLAIN = ("take", "release", "record", "stop_recording", "save", "stop_trial")
KINDS = ("let_down", *OF_ONE_ARM, *PLAIN, "trial")
WITHOUT_CONTROL = ("let_down", "take")


@dataclass(frozen=True)
class Action:
    """One request. arm: '' for all arms or none. values: parameters of the arm's compensator. name: of the trial."""

    kind: str
    arm: str = ""
    values: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""

    def __str__(self) -> str:
        """Describe the action for the log, without the wearer's data."""
        shown = [f"{key} = {value}" if not key.startswith("wearer.") else key for key, value in self.values.items()]
        parts = (self.kind.replace("_", " "), self.arm, ", ".join(shown), self.name)
        return " ".join(part for part in parts if part)


def parse(body: Any, arms: Collection[str], trials: Collection[str]) -> Action:
    """Return the action that the JSON value `body` describes. Raises ParameterError."""
    if not isinstance(body, dict):
        raise ParameterError("request", body, "an object")
    kind = body.get("do")
    if kind not in KINDS:
        raise ParameterError("do", kind, f"one of {', '.join(KINDS)}")
    allowed = {"do"} | _keys(kind)
    if unknown := set(body) - allowed:
        raise ParameterError("request", sorted(unknown), f"without keys other than {', '.join(sorted(allowed))}")
    arm = body.get("arm", "")
    if (kind in OF_ONE_ARM or arm != "") and arm not in arms:
        raise ParameterError("arm", arm, f"one of {', '.join(sorted(arms)) or 'none: no arm is present'}")
    if kind == "trial":
        if body.get("name") not in trials:
            raise ParameterError("trial", body.get("name"), f"one of {', '.join(sorted(trials))}")
        return Action(kind, name=body["name"])
    return Action(kind, arm, _values(body.get("values")) if kind == "set" else {})


def _keys(kind: str) -> set[str]:
    keys = {"trial": {"name"}, "set": {"arm", "values"}}
    return keys.get(kind, {"arm"} if kind in (*OF_ONE_ARM, "let_down") else set())


def _values(given: Any) -> dict[str, Any]:
    if not isinstance(given, dict) or not given:
        raise ParameterError("values", given, "an object of parameters")
    for name in given:
        if name not in SETTABLE:
            raise ParameterError("values", name, f"one of {', '.join(SETTABLE)}")
    return {name: SETTABLE[name].check(value) for name, value in given.items()}
