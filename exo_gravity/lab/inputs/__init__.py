"""What the tools read: parameter files, the arms in them, installed executables, and the references."""
