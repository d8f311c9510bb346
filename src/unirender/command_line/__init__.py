"""The commands that run the model, and how a command is read and ends. Light to import."""
