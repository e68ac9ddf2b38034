# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Benchmarks: `make bench` runs them all and prints one table. They measure and assert nothing."""
