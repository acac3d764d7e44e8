"""The simulated sky and its sensors: what a log's truth is.

It works with barycentric vectors, exact light time and a Lorentz boost, and imports nothing
of the pipeline's own mathematics: a wrong sign in either shows when they meet.
"""
