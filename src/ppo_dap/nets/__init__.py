"""Networks: multilayer perceptrons, adapters, and what the actor and the critic are made of."""
