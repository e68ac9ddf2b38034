"""The subcommands of `calibrate`: one module each, with what they share."""
