# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The tests. NumPy's threads are set before it is imported."""

import os

# Threads of BLAS that wait for each other spin: beside other work an identification takes minutes in place of a second.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
