"""Training an ANFIS: its samples, computed or recorded, and the learning itself."""
