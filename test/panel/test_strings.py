# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The page's texts: complete in every language, and all that the page asks for."""

import json
import re
from pathlib import Path

import exo_gravity.panel
from exo_gravity.core.safety.drive import FaultCode, State
from exo_gravity.core.vocabulary import Source, Wait, WeighingPhase, WeighingTrouble, Withdrawal
from exo_gravity.panel.view import PANEL
from exo_gravity.sim.script import TIMED, VALUED

FOLDER = Path(exo_gravity.panel.__file__).parent
CONTENT = json.loads((FOLDER / "strings.json").read_text(encoding="utf-8"))
TEXTS = CONTENT["texts"]
SCRIPTS = sorted((FOLDER / "static").glob("*.js"))


def test_every_text_exists_in_every_language_with_the_same_values():
    for key, texts in TEXTS.items():
        assert len(texts) == len(CONTENT["languages"]), key
        assert all(text.strip() for text in texts), key
        assert len({tuple(sorted(set(re.findall(r"\{\d\}", text)))) for text in texts}) == 1, key


def test_every_fault_state_and_step_of_a_trial_has_its_texts():
    assert {f"{kind}.{code}" for kind in ("fault", "do") for code in FaultCode} <= TEXTS.keys()
    assert {f"{kind}.{state.value}" for kind in ("state", "sentence") for state in State} <= TEXTS.keys()
    assert {f"step.{action}" for action in (*TIMED, *VALUED)} <= TEXTS.keys()


def test_every_word_of_the_nodes_that_an_operator_must_understand_has_its_text():
    words = {"wait": Wait, "reason": Withdrawal, "trouble": WeighingTrouble, "source": Source}
    for kind, vocabulary in words.items():
        assert {f"{kind}.{word}" for word in vocabulary} <= TEXTS.keys()
    phases = set(WeighingPhase) - {WeighingPhase.NONE}
    assert {f"weighing.{phase}" for phase in phases} <= TEXTS.keys()
    (markers,) = (param.default for param in PANEL if param.name == "markers")
    assert {f"marker.{text}" for text in markers} <= TEXTS.keys()


def test_the_page_asks_for_texts_that_exist():
    page = (FOLDER / "static" / "index.html").read_text(encoding="utf-8")
    asked = set(re.findall(r'data-text="([^"]+)"', page))
    for script in SCRIPTS:
        asked |= set(re.findall(r'\bt\("([^"]+)"', script.read_text(encoding="utf-8")))
    assert asked <= set(TEXTS)
    assert len(asked) > 50
