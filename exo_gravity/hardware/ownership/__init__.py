"""Who owns a bus, and what happens to its arm when the owner dies."""
