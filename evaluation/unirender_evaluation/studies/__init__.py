"""Studies beside the benchmark: what a choice is worth, measured with the benchmark's suites, metrics and records.

| package | command | what it asks |
|---|---|---|
| `derived_light` | `bench derived-light` | how near s and d come to Mitsuba's when they are derived in closed form |
| `optimiser` | `bench ingredients`, `bench race` | what each ingredient of the optimiser is worth, and how fast it is |
| `sampling` | `bench sampling` | what steps and samples are worth, and whether their spread is their error |
| `speed` | `bench speed` | how long everything takes |
| `training` | `bench training` | what the choices of training are worth |
| `unknown_mesh` | `bench unknown-mesh` | how well shape, material and light are found from pictures alone |
| `warm_start` | `bench warm-start` | what the model's prediction is worth as the start of an optimisation |

Each has the modules `command` (light to import), `run` (measures, prints, writes) and, but for `speed`, `tables`; the
two commands of `optimiser` are in `commands`, which run it as well. They share `about`, `cells`, `folder`,
`progress` and `rows`. No result of `bench run` depends on a study.
"""
