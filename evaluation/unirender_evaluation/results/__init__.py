"""Results as files: what they hold, whether they are right, and work on several of them."""
