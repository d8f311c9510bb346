"""`unirender demo`: a page in the browser. Drop in a picture, see its maps, edit, relight, and let Mitsuba check it.

| module | what it is for |
|---|---|
| `command` | the command line |
| `uploads` | what visitors hand in: files, their limits |
| `session` | the sequence picture -> decomposition -> edit, light -> check, as plain functions |
| `downloads` | the maps and scenes as archives |
| `panels` | pictures and captions as HTML |
| `jobs` | one function for each thing that the page asks for |
| `worker` | the process that runs them, each within a time limit |
| `widgets` | what stands where on the page |
| `page` | the page itself; the only modules that know gradio are `page`, `widgets` and `server` |
| `server` | serves it, and sees to it that it asks no other host |
"""
