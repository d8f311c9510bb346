"""The scorer: metrics, suites, methods, tables and the physics table."""
