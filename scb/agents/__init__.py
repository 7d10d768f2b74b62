"""Agents: static configuration apart from traced hyperparameters, pure functions of keys."""
