# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""What the tools read: parameter files, the arms in them, installed executables, and the references."""
