"""The search: hypotheses of an attitude, and the verdict on each.

Words that the modules share:

- i, j are centroids, a, b the stars that they are taken for; all are rows.
- pivot, companion: the centroid that is taken for one star after the other, and another one in the
  image, which votes.
- near, entry, other: the neighbours of all stars on the sky; a row of them; the star in that row.
- c, chord: the separation of two directions, 2 sin(angle / 2).
- angle, turn: the position angle of a companion about the pivot; that of a star about another star.
  Their difference is a roll. All are in parts of `TURN`.
- wide: the tolerance of an angle or of a roll, in parts of `TURN`.
- way: which star of a pair of the table is the pivot, 0 for the first and brighter one.
- m_i, m_j, m_ij: the magnitudes that two fluxes imply, and their difference.
"""
