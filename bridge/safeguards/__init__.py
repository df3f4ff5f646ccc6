"""What stops the vehicle: the state machine, stops from outside, the guard."""
