"""The commands that run the model, and how a command is read, speaks and ends. Light to import."""
