"""What a bandit knows about its environment: optimal actions, importance of observations, states."""
