# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What stands between the requested efforts and the motors of a worn arm."""
