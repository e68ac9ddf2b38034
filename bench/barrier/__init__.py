"""The barrier on driven speed: rules for it, on arms that would be thrown and on wearers who must move freely."""
