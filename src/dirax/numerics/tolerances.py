"""Every threshold below which a number counts as zero, with its reason. All are relative, to what each line says.

What a *user* may choose (a tolerance argument) has its default here. When Newton's method of a step stops is no such decision:
it runs to the roundoff floor, see `dirax.engines.stopping`.
"""

EPSILON = 2.0**-52
"""The distance from 1 to the next number."""

SMALLEST = 2.0**-1022 / EPSILON
"""Numbers below this do not have all their digits, or come of products that do not, and count as zero."""

TINY = 1e-300
"""Stands in for a size that is zero, where one divides by it or compares with it."""

# ---- Ranks: singular values that are zero, relative to the largest unless said otherwise ----

STRUCTURE_RANK = 1e-10
"""Of matrices that state a linear Dirac structure. Half of the digits that a user's data may have lost, and a singular value
that is not separated from it by RANK_GAP raises instead of being decided."""

RANK_GAP = 100.0
"""A singular value within this factor of the tolerance, on either side, leaves the rank of a stated structure undecided."""

RANK_ROUNDOFF = 2e-13
"""Below this they are roundoff of a few products and factorizations in dimensions up to dozens, and zero without a gap."""

TRANSVERSALITY = 1e-12
"""Where a pull-back, push-forward or composition counts as not transversal. Smaller than STRUCTURE_RANK, since such a singular
value may be the square of the angle at which two subspaces meet."""

EQUATION_RANK = 1e-12
"""Of equilibrated equations: the matrix of a first step, constraint matrices, Newton's. Their entries are derivatives of the
user's functions at one point, exact up to roundoff, which a few thousand operations bring to this."""

ONE_FORM_RANK = 1e-12
"""Of one-forms at a point, for the same reason; directions and group algebras that users give as rows are judged by it too."""

RATE_RANK = 1e-10
"""Of the equations of (ẋ, λ) of a Dirac system at initial data, as of the structures that these equations state."""

HESSIAN_RANK = 1e-9
"""Of ∂²L/∂v²: a basis of its kernel becomes primary constraints, and L may be stated through roots and quotients that lose
some digits."""

MANIFOLD_RANK = 1e-8
"""Of the equations of (ẋ, u) with unit rows, relative to 1 or the largest, at points found on constraint manifolds: these lie
there up to ON_MANIFOLD, and a rank that drops there only shows as values somewhat larger than that."""

STEP_RANK = 1e-11
"""Of the equilibrated Jacobian of a step, relative to 1 or the largest: the values of a constraint of index ν are of size h^ν,
so that this is as small as JACOBIAN_NOISE permits."""

PAIR_RANK = 1e-10
"""Of the constraints on pairs of points, with unit rows."""

INERTIA_RANK = 1e-13
"""Of inertia matrices in unit size: entries of 1e-12 beside others may be physical, as moments of a slender body are."""

METRIC_RANK = 1e-12
"""Of ∂²L/∂v² as a metric: where its least eigenvalue is below this, or negative, the Euclidean metric is used instead."""

JACOBIAN_NOISE = 1e-13
"""Entries of a Jacobian below this, relative to its largest, are roundoff of derivatives that are zero."""

PIVOT = 1e-10
"""Entries of equilibrated equations below this are no pivots, and count as zero in the elimination that looks for them."""

LARGEST_CONDITION = 1e15
"""Condition number from which a Jacobian counts as singular when a failed step is explained: hardly a digit is left."""

# ---- Defects: by how much something is missed that is to hold ----

STRUCTURE_DEFECT = 1e-10
"""Of skewness, isotropy, membership, symmetry or an axiom, relative to the size of what is compared: stated by users through
matrices and functions, which may come from tables with ten digits."""

SYMMETRY_DEFECT = 1e-9
"""Of invariance: derivatives of the user's functions at random points, relative to the sizes of their terms."""

ACTION_DEFECT = 1e-9
"""Of the laws of a group action at random elements, relative to 1 and the size of the point."""

GROUP_DEFECT = 1e-9
"""Of a matrix, quaternion or vector that is to be an element of a Lie group: users normalise by hand."""

POINT_DEFECT = 1e-8
"""Of points and vectors handed to a function that needs them on a manifold, or in its tangent space: more than roundoff
leaves after a long run, less than any mistake."""

FRAME_DEFECT = 1e-9
"""The columns of a frame, and how far they are from a distribution that it is to span, both of length 1."""

CONSTRAINT_DEFECT = 1e-9
"""Of constraints at initial data and at nodes, relative to the sizes of their terms."""

SOLVED_ROUNDOFF = 1e-5
"""How much of the largest unknown of linear equations counts in every other one where CONSTRAINT_DEFECT compares what they leave:
together they are the roundoff of a decomposition."""

ON_MANIFOLD = 1e-10
"""Of conditions at a point that Gauss–Newton has put on their zeros, relative to their derivative and to the point."""

OFF_MANIFOLD = 1e-8
"""A point with larger values of a constraint, relative to the same, is off the final manifold: a hundred times what the search
for such points leaves."""

BRACKET_DEFECT = 1e-8
"""Of the bracket of two constraints, relative to the sizes of their derivatives: second derivatives of the user's functions."""
