"""Other people's published pipelines as benchmark methods."""
