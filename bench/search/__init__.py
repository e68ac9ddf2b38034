# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Search for unlisted events that throw an arm: random pairs in virtual time, judged by the arm's true motion."""
