"""The oscillator: laws, belts, modes with their transitions, equilibria."""
