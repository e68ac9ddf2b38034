"""The motors' CAN bus."""
