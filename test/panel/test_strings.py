"""The page's texts: complete in every language, and all that the page asks for."""

import json
import re
from pathlib import Path

import pytest

import exo_gravity.panel
from exo_gravity.core.safety.drive import FaultCode, State
from exo_gravity.core.trial.script import TIMED, TURNS

FOLDER = Path(exo_gravity.panel.__file__).parent
CONTENT = json.loads((FOLDER / "strings.json").read_text(encoding="utf-8"))
TEXTS = CONTENT["texts"]
SCRIPTS = sorted((FOLDER / "static").glob("*.js"))


@pytest.mark.parametrize("key", TEXTS)
def test_a_text_exists_in_every_language_with_the_same_values(key):
    texts = TEXTS[key]
    assert len(texts) == len(CONTENT["languages"])
    assert all(text.strip() for text in texts)
    assert len({tuple(sorted(set(re.findall(r"\{\d\}", text)))) for text in texts}) == 1


@pytest.mark.parametrize("code", FaultCode)
def test_every_fault_has_a_remedy(code):
    assert f"fault.{code}" in TEXTS


@pytest.mark.parametrize("state", State)
def test_every_state_has_a_word_and_a_sentence(state):
    assert f"state.{state.value}" in TEXTS
    assert f"sentence.{state.value}" in TEXTS


@pytest.mark.parametrize("action", [*TIMED, *TURNS, "move", "push"])
def test_every_step_of_a_trial_has_an_instruction(action):
    assert f"step.{action}" in TEXTS


def test_the_page_asks_for_texts_that_exist():
    page = (FOLDER / "static" / "index.html").read_text(encoding="utf-8")
    asked = set(re.findall(r'data-text="([^"]+)"', page))
    for script in SCRIPTS:
        asked |= set(re.findall(r'\bt\("([^"]+)"', script.read_text(encoding="utf-8")))
    assert asked <= set(TEXTS)
    assert len(asked) > 50
