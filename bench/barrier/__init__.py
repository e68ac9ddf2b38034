# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The barrier on driven speed: rules for it, on arms that would be thrown and on wearers who must move freely."""
