"""The live page: a person fails by hand, and watches misstep learn from it.

::

    page (browser)  --keys, buttons-->  server  -->  Session  -->  Attempt (physics, its own clock)
                    <--states, news---                  |
                                                        +----->  Worker (a process: learns, reads,
                                                                 writes, fits)

One server has one `Session`. All of it happens in one event loop, so that nothing in it needs a
lock; whatever takes long happens in the worker's process, so that the page never waits for it.
What is recorded is in a file before the page is told so.
"""
