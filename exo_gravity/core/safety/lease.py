# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Control of one arm: a lease that carries its holder's name, and that only its holder can renew.

    hold     takes the lease if it is free, and renews it
    take     takes it from its holder
    release  gives it back: the arm stays as it is

A lease that is not renewed for LEASE_TIME runs out: its holder is gone, and the arm must not be carried without them.
While no one holds the lease, the arm is carried without an operator.

LEASE_TIME is chosen for a holder on Wi-Fi that sends three times a second over TCP. A station that roams or scans is
silent for 0.1 to 0.5 s. TCP sends again 0.2 and 0.6 s after a loss, so after a gap of up to 0.6 s the next message is
at most 0.9 s behind the last one. A longer gap lets the arm down.
"""

LEASE_TIME = 1.0  # s
LONGEST_NAME = 64


class Lease:
    """The lease of one arm. holder: name of its holder, '' for none. All times are in s on one monotonic clock."""

    def __init__(self) -> None:
        self.holder = ""
        self._renewed = 0.0
        self._refused = ""  # the last one, which repeats its request

    def request(self, now: float, name: str, kind: str) -> str:
        """Do what `name` asks for: `kind` is hold, take or release. Return a sentence for the log if it is news."""
        if not (name.isprintable() and 0 < len(name) <= LONGEST_NAME) or kind not in ("hold", "take", "release"):
            name, refusal = "?", f"control: needs a name of 1 to {LONGEST_NAME} letters and hold, take or release"
        elif kind == "release":
            if name != self.holder:
                return ""
            self.holder = ""
            return f"{name} has released control"
        elif self.holder in ("", name) or kind == "take":
            before, self.holder, self._renewed, self._refused = self.holder, name, now, ""
            taken = f"{name} has taken control from {before}" if before else f"{name} holds control"
            return "" if before == name else taken
        else:
            refusal = f"{name} may not hold control: {self.holder} does"
        is_news, self._refused = name != self._refused, name
        return refusal if is_news else ""

    def lost(self, now: float) -> str:
        """Return who has lost control and why if the lease has run out, after which it is free; else ''."""
        if not self.holder or now - self._renewed <= LEASE_TIME:
            return ""
        reason, self.holder = f"{self.holder} held control and has not renewed it for {LEASE_TIME:g} s", ""
        return reason
