"""How near s and d come to Mitsuba's when they are derived from (normal, roughness, light): `bench derived-light`."""
