"""What steps and samples are worth to our model, and whether their spread is their error: `bench sampling`."""
