"""Track linking: one object's runs of one sensor, broken where frames missed the object.

`likelihood_ratio` is the default, `prediction` a published method. Both return which fragment
continues which: each continues at most one and is continued by at most one, best as a whole.
Several links make a chain.
"""
