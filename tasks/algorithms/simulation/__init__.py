"""The simulated sky and its sensors: the truth that a simulated log is made of.

Barycentric vectors, iterated light time and a Lorentz boost, with the simulator's constants
and time scales. Nothing of the pipeline's mathematics is imported: an error of sign in one of the
two shows as a disagreement.
"""
