"""Track linking: joins the runs of one object in one sensor that missed detections separate.

`likelihood_ratio` is the default, `prediction` a published method. Both return which fragment
continues which, with the maximum total gain: each continues at most one and is continued by at
most one. Successive links make a chain.
"""
