# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A session: the subject's code names a folder, and texts are short."""

from datetime import date

import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.lab.trial.session import Session


@pytest.mark.parametrize("code", ["", "P01", "0042", "pilot-3_b", "A" * 32])
def test_a_code_names_the_folder_of_the_subject_and_the_day_and_without_one_there_is_none(code):
    assert Session(code).folder(date(2026, 3, 14)) == (f"{code}/2026-03-14" if code else "")


@pytest.mark.parametrize("code", ["Anna Meier", "../P01", "a/b", ".", "-P01", "Jörg", "P01\n", "A" * 33, "P.1", "CON:"])
def test_characters_that_do_not_belong_in_the_name_of_a_folder_are_refused(code):
    with pytest.raises(ParameterError, match=r"subject = .*: must be a code"):
        Session(code)


HALF = ({"note": "calm \ud83d"}, {"protocol": "a\0"})  # an emoji cut by a field's maxlength; a C string ends there


@pytest.mark.parametrize("wrong", [{"note": "x" * 1001}, {"protocol": 1}, {"subject": None}, *HALF])
def test_a_text_that_is_too_long_or_no_whole_text_is_refused(wrong):
    with pytest.raises(ParameterError, match=next(iter(wrong))):
        Session(**wrong)
