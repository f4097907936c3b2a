"""The network: encoding, rotations, inference, weights."""
