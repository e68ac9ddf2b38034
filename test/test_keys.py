# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What programs read: docs/keys.md has every word of the code and no other, and nothing of ours parses a sentence."""

from __future__ import annotations

import ast
import copy
import pickle
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from exo_gravity.core import vocabulary
from exo_gravity.core.safety.drive import FaultCode, State
from exo_gravity.core.safety.start import TRANSIENT_FAULTS
from exo_gravity.core.vocabulary import NONE, TEXT, Reason, Word
from exo_gravity.lab import vocabulary as of_lab

from .support.keys import documented, row_of

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "exo_gravity"
PASSING = TRANSIENT_FAULTS - {FaultCode.OUTSIDE_LIMITS}  # faults that a start waits out; that one has a word of its own
# The words of each node's key.
VOCABULARY: dict[tuple[str, str], Iterable[str]] = {
    ("", "clock"): vocabulary.ClockState,
    ("can_bridge", "state"): (*State, vocabulary.INACTIVE),
    ("can_bridge", "source"): vocabulary.Source,
    ("can_bridge", "motors"): vocabulary.Motors,
    ("can_bridge", "waiting for"): {*vocabulary.Wait, *PASSING} - {vocabulary.Wait.MOTOR_ON},
    ("can_bridge", "refusal"): {*vocabulary.Wait, *PASSING},
    ("can_bridge", "resume"): vocabulary.Resume,
    ("can_bridge", "request"): ("enable", "let_down", "clear_fault", "resume", "confirm_pose", "set_zero"),
    ("can_bridge", "answer"): vocabulary.Answer,
    ("can_bridge", "warnings"): vocabulary.BridgeWarning,
    ("can_bridge", "refused message"): vocabulary.RefusedEfforts,
    ("compensator", "state"): vocabulary.CompensatorState,
    ("compensator", "reason"): vocabulary.Withdrawal,
    ("compensator", "warnings"): vocabulary.CompensatorWarning,
    ("compensator", "support request"): vocabulary.SupportRequested,
    ("compensator", "assist reason"): vocabulary.AssistProblem,
    ("compensator", "weighing"): of_lab.WeighingPhase,
    ("compensator", "weighing trouble"): of_lab.WeighingTrouble,
    ("compensator", "weigh refused"): of_lab.WeighingRefused,
    ("wearer", "state"): of_lab.WearerState,
    ("wearer", "reason"): of_lab.NoEstimate,
    ("wearer", "budget"): of_lab.Budget,
    ("wearer", "support adapts"): of_lab.Adapts,
    ("imu", "state"): vocabulary.ImuState,
    ("simulator", "warnings"): of_lab.SimulatorWarning,
}
PARAMETERS = {"position_min", "position_max", "use_sim_time"}
BESIDE = ("simulator", "robot_model", "panel", "calibrator")  # nodes whose states are of one enumeration


def as_words(found: Iterable[object]) -> set[str]:
    """Return what programs get of these words."""
    return {str(getattr(word, "value", word)) for word in found}


def documented_words(node: str, key: str) -> set[str]:
    """Return the words that the page has for a key, and the keys that it names there."""
    row = row_of(node, key)
    assert row, f"{node}: {key}"
    return {word for word in row.words if re.fullmatch("[a-z_ ]+", word)}


@pytest.mark.parametrize(("node", "key"), VOCABULARY)
def test_the_page_has_each_word_of_the_code_and_no_other(node: str, key: str) -> None:
    words, shown = as_words(VOCABULARY[node, key]), documented_words(node, key)
    assert words - {NONE} <= shown
    assert shown - words - {NONE} <= documented()[node].keys() | PARAMETERS


def test_every_word_belongs_to_a_key_and_every_state_of_other_nodes_is_documented() -> None:
    used = {type(word) for words in VOCABULARY.values() for word in words}
    assert {*Word.__subclasses__()} - used == {of_lab.NodeState}
    assert {word for node in BESIDE for word in documented_words(node, "state")} == as_words(of_lab.NodeState)
    assert documented()[""]["interface"].words == {str(vocabulary.INTERFACE)}


# No sentence is parsed

SENTENCES = {"message", "text", "reason", "sentence", "problem", "trouble", "hint", "refusal", "waiting_for"}
SEARCHES = {
    "startswith", "endswith", "split", "rsplit", "partition", "rpartition", "find", "rfind", "index", "count",
    "removeprefix", "removesuffix", "match", "fullmatch", "search", "findall", "finditer", "splitlines", "lower",
}  # fmt: skip
IN_SCRIPT = re.compile(
    r"""(\.message|\[[`'"][^`'"]*\stext[`'"]\]|\bmessage|\bsentence)\s*(\?\?\s*[^)]*\))?\s*\??
    \.(match|matchAll|includes|startsWith|endsWith|search|split|indexOf|replace)\(""",
    re.VERBOSE,
)
# Whose `text` is that of a file.
FILES = {PACKAGE / "core/arm/anfis.py", PACKAGE / "lab/calibration/result.py"}


def is_sentence(node: ast.expr) -> bool:
    """Return whether an expression is a sentence for people, by its name: an attribute, or the value of a key."""
    if isinstance(node, ast.Attribute):
        return node.attr in SENTENCES
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "get" and node.args:
        return _is_key(node.args[0])
    return isinstance(node, ast.Subscript) and _is_key(node.slice)


def _is_key(node: ast.expr) -> bool:
    key = node.value if isinstance(node, ast.Constant) else None
    return isinstance(key, str) and (key == "message" or key.endswith(TEXT))


def parsed_in(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield what searches a sentence, or compares it with a given one."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            searches = any(isinstance(op, ast.In | ast.NotIn) for op in node.ops) and is_sentence(sides[-1])
            given = [side for side in sides if isinstance(side, ast.Constant) and isinstance(side.value, str)]
            if searches or (any(map(is_sentence, sides)) and any(side.value for side in given)):
                yield node
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in SEARCHES:
            yield from [node] * any(map(is_sentence, (node.func.value, *node.args)))


def test_no_module_and_no_script_of_the_page_searches_a_sentence_or_compares_it() -> None:
    modules = {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}
    found = [
        f"{path}: {ast.unparse(node)}"
        for path, tree in modules.items() if path not in FILES for node in parsed_in(tree)
    ]  # fmt: skip
    scripts = sorted((PACKAGE / "panel" / "static").glob("*.js"))
    found += [f"{path}: {hit[0]}" for path in scripts for hit in IN_SCRIPT.finditer(path.read_text("utf-8"))]
    assert scripts and not found
    assert list(parsed_in(ast.parse('status.message.startswith("fault")')))  # would be found


def test_a_reason_is_its_sentence_and_keeps_its_word_when_it_is_copied() -> None:
    reason = Reason(vocabulary.Wait.REST, "the arm to be at rest")
    for same in (reason, copy.deepcopy(reason), pickle.loads(pickle.dumps(reason))):
        assert (same, same.word, f"{same}!") == ("the arm to be at rest", "rest", "the arm to be at rest!")
    assert not vocabulary.NO_REASON and vocabulary.NO_REASON.word == NONE
