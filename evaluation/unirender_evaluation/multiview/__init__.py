"""The multi-view table: one object seen from cameras around it, optimised until it looks like its pictures.

| module | what it is for |
|---|---|
| `settings` | what is rendered for the table |
| `scenes` | the scenes: views to start from, views to score, the true object |
| `methods` | the optimisations, and the constant that they must beat |
| `scoring` | scores of a result: its maps, its light, its pictures from cameras it never saw |
| `rows` | which row is scored on which scene, and the records |
| `pictures` | what the results look like, for the report |
| `tables` | the columns |
"""
