"""Public test sets in a user's own folder, scored as each set's own benchmark does: `bench public`.

| module | what it is for |
|---|---|
| `command` | the command line |
| `run`, `answers`, `rows` | asks every row about every sample and keeps the records |
| `sets` | what a set must offer, and what the readers share; `scenes`: what those of whole scenes share |
| `orb`, `orb_frames`, `orb_scoring` | Stanford-ORB |
| `iiw`, `maw` | Intrinsic Images in the Wild; Measured Albedo in the Wild |
| `metrics` | the sets' metrics, from their definitions |
| `tables` | the tables |
"""
