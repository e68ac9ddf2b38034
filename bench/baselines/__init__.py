# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What others use in place of a model, and the growth of an ANFIS with its inputs: `make study NAME=baselines`."""
