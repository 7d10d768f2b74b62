"""Environments: synthetic bandits, and adapters that put other suites behind gymnax 1.x's interface."""
