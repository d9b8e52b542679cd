"""A walk to look at: films, and pages in the browser of a run or of a robot that walks live.

`video` and `render` film, `page` shows a run, `live_page` a robot that walks in the process of
`sim.live`; `pictures` draws all that one command shows.
"""
