"""The physics table: what light does whatever the scene, asked of every method, and `bench physics`, which proves it.

| module | what it is for |
|---|---|
| `formulas` | the formulas, asked of a renderer or a decomposition |
| `stage` | one scene as the tests see it: true maps, true pictures, what Mitsuba makes of found maps |
| `ambiguity` | the materials that explain a picture, found by Mitsuba |
| `region` | the 90 % region of a posterior of which only samples are known |
| `questions` | what is asked of a decomposer or a posterior on one scene |
| `definition` | what a test is |
| `tests` | the tests, a row each, and the table's columns |
| `twins` | what each test must refuse |
| `rows` | which row of the benchmark answers which test |
| `tracer` | Mitsuba's path tracer as a renderer of maps |
| `run`, `command` | `bench physics` and its command line |
"""
