"""How long our model, Mitsuba, a cold start and training take: `bench speed`."""
