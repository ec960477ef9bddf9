"""Joints that follow another: q = q₀ + Σ aᵢ (leader − leader₀)ⁱ, MuJoCo's joint equality.

Only hinges and slides can be coupled; a leader never follows anybody itself, ``model_tree`` sees to it.
"""
# mypy: disallow-untyped-defs = false, check-untyped-defs = false

from robot_ik.kernels.jit import outlined, pure


@outlined
def follow(tree, q):
    """Puts every tied joint where its leader wants it, in place."""
    tied, law, qadr = tree.tied, tree.law, tree.qadr
    for c in range(tied.shape[0]):
        value = 0.0
        if tied[c, 1] >= 0:
            x = q[qadr[tied[c, 1]]] - law[c, 1]
            value = x * (law[c, 3] + x * (law[c, 4] + x * (law[c, 5] + x * law[c, 6])))
        q[qadr[tied[c, 0]]] = law[c, 0] + law[c, 2] + value


@pure
def slope_of(tree, c, q):
    """How far coupling ``c`` moves its joint per unit of the leader."""
    law = tree.law
    x = q[tree.qadr[tree.tied[c, 1]]] - law[c, 1]
    return law[c, 3] + x * (2.0 * law[c, 4] + x * (3.0 * law[c, 5] + x * 4.0 * law[c, 6]))
