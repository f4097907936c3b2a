"""Training of the network in the twin: environment, collection, replay, learning."""
