"""One page at a time holds control; a page that is gone is noticed."""

import pytest

from exo_gravity.panel.control import BURST, FORGOTTEN, GONE, MAX_PAGES, REFILL, Control


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    """A clock that a test sets."""
    return Clock()


@pytest.fixture
def control(clock: Clock) -> Control:
    """No pages yet."""
    return Control(clock)


def opened(control: Control, secret: str = "") -> str:
    result = control.open(secret, "127.0.0.1")
    assert result is not None
    return result[0]


def test_the_first_page_holds_control_and_the_second_watches_until_it_takes_it(control):
    first, second = opened(control), opened(control)
    assert control.holds(first)
    assert not control.holds(second)
    control.take(second)
    assert control.holds(second)
    assert not control.holds(first)


def test_an_unknown_page_never_holds_control(control):
    control.take("guessed")
    assert not control.holds("guessed")
    assert not control.holds("")
    assert control.holder is None


def test_a_reloaded_page_keeps_its_number_and_control(control):
    first = opened(control)
    number = control.page(first).number
    control.close(first)
    assert opened(control, first) == first
    assert control.page(first).number == number
    assert control.holds(first)


def test_a_secret_that_the_panel_did_not_give_is_not_accepted(control):
    assert opened(control, "my own") != "my own"


def test_the_operators_page_is_gone_when_it_confirms_nothing_for_two_seconds(control, clock):
    page = opened(control)
    clock.now += GONE
    assert not control.is_gone()
    clock.now += 0.01
    assert control.is_gone()
    control.confirm(page)
    assert not control.is_gone()


def test_a_new_page_holds_control_if_the_operators_page_is_gone(control, clock):
    opened(control)
    clock.now += GONE + 0.1
    assert control.holds(opened(control))


def test_with_dead_man_the_page_that_holds_control_is_not_forgotten(clock):
    control = Control(clock, dead_man=True)
    operator = opened(control)
    control.close(operator)
    for _ in range(MAX_PAGES - 1):
        opened(control)
    assert control.open("", "127.0.0.1") is None
    clock.now += FORGOTTEN + 1.0
    control.open("", "127.0.0.1")
    assert control.is_gone()


def test_a_watching_page_that_is_gone_does_not_count(control, clock):
    operator, _ = opened(control), opened(control)
    clock.now += GONE + 0.1
    control.confirm(operator)
    assert not control.is_gone()


def test_a_page_may_send_a_burst_of_actions_and_then_only_so_many_a_second(control, clock):
    page = opened(control)
    assert [control.spend(page) for _ in range(int(BURST) + 1)] == [True] * int(BURST) + [False]
    clock.now += 1.0
    assert [control.spend(page) for _ in range(int(REFILL) + 1)] == [True] * int(REFILL) + [False]
    assert not control.spend("guessed")


def test_pages_do_not_grow_without_end(control, clock):
    pages = [opened(control) for _ in range(MAX_PAGES)]
    assert control.open("", "10.0.0.1") is None
    control.close(pages[5])
    opened(control)
    assert control.page(pages[5]) is None
    control.close(pages[6])
    clock.now += FORGOTTEN + 1.0
    opened(control)
    assert control.page(pages[6]) is None
