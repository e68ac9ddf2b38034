# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What programs read: docs/keys.md has every word of the code and no other, and nothing of ours parses a sentence."""

import re
from collections.abc import Iterable
from pathlib import Path

import pytest

from exo_gravity.core import vocabulary
from exo_gravity.core.safety.command import FaultCode, State
from exo_gravity.core.safety.start import TRANSIENT_FAULTS
from exo_gravity.core.vocabulary import NONE, Status, Word
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


# Of Python and of JavaScript: a sentence for people, by its name, that is searched.
SEARCHED = re.compile(
    r"""(\.(message|reason|sentence|problem|trouble|hint|refusal|waiting_for)|\[[`'"][^`'"]*(message|\stext)[`'"]\])
    \s*(\?\?\s*[^)]*\))?\s*\??\.(startswith|endswith|r?split|r?partition|r?find|index|lower|remove(pre|suf)fix|
    match|matchAll|includes|startsWith|endsWith|search|indexOf|replace)\(""",
    re.VERBOSE,
)


def test_no_module_and_no_script_of_the_page_searches_a_sentence() -> None:
    paths = sorted((*PACKAGE.rglob("*.py"), *(PACKAGE / "panel" / "static").glob("*.js")))
    assert [path.suffix for path in paths].count(".js")
    assert not [f"{path}: {hit[0]}" for path in paths for hit in SEARCHED.finditer(path.read_text("utf-8"))]
    assert SEARCHED.search('status.message.startswith("fault")')  # would be found


def test_a_status_is_written_as_its_sentence_and_is_false_without_one() -> None:
    assert f"{Status(vocabulary.Wait.REST, 'the arm to be at rest')}!" == "the arm to be at rest!"
    assert not vocabulary.NO_REASON and vocabulary.NO_REASON.code == NONE
