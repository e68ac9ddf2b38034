"""A search for ways to throw an arm that nobody listed: random pairs of events in virtual time, judged by the truth."""
