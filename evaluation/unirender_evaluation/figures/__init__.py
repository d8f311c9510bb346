"""The paper's kinds of figure, drawn anew from a suite or from somebody's own pictures: `unirender figures`.

| module | what it is for |
|---|---|
| `command` | the command line |
| `grid` | draws a grid of labelled pictures |
| `panels` | material strips, relighting, comparison: methods beside the truth |
| `overview` | everything that a method makes of one picture |
| `light` | balls under the light that a method finds |
| `contract` | every map of a scene, and the camera with its axes |
| `pictures` | what methods find in somebody's own pictures |
"""
