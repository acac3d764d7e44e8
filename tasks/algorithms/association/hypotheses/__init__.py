"""Hypotheses: pairs of tracklets, and the groups that grow from them."""
