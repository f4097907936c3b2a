"""One model of pushes: their line, the physics of what they move, what comes of them, and what that is worth."""
