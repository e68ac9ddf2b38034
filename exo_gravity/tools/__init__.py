# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Command-line tools: one file per command, one folder per family of helpers."""
