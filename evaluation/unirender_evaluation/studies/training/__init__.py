"""What the choices of training are worth, on one small network: `bench training`."""
