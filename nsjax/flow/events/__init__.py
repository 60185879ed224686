"""What happens at an event: where it is, the jump of the state, the choice of the mode."""
