"""The data-flow reader on functions whose flow is plain to see: it gives exactly that flow."""

import jax
import jax.numpy as jnp
import pytest
from jax.ad_checkpoint import checkpoint_name

from ppo_dap.dap.dataflow import KNOWN, UNKNOWN, trace

ARGUMENTS = {name: jnp.arange(1.0, 4.0) for name in "abc"}


def flow_of(function, **options):
    return trace(function, ARGUMENTS).flow(**options)


def outputs_of(function):
    """Output name -> the arguments that reach it, as one sorted string."""
    return {name: "".join(sorted(labels)) for name, labels in flow_of(function).outputs.items()}


def delay(a, b, c):
    """Four steps of x, y, z = y, z, a: a needs three steps to reach x."""
    (x, y, z), _ = jax.lax.scan(lambda carry, _: ((carry[1], carry[2], a), None), (b, c, c), None, length=4)
    return {"x": x, "y": y, "z": z}


def while_delay(a, b, c):
    def body(state):
        return state[0] + 1, state[2], a, state[3]

    i, x, y, still = jax.lax.while_loop(lambda state: state[0] < 3, body, (0, b, b, c))
    return {"i": i, "x": x, "y": y, "still": still}


def while_condition(a, b, c):
    x, _ = jax.lax.while_loop(lambda state: state[0][0] < c[0], lambda s: (s[0] + a, s[1]), (b, b))
    return {"x": x}


def branches(a, b, c):
    x, y = jax.lax.cond(c[0] > 0, lambda a, b: (a, b), lambda a, b: (2 * a, a), a, b)
    return {"x": x, "y": y}


def barrier(a, b, c):
    x, y = jax.lax.optimization_barrier((a, b))
    return {"x": x, "y": y, "z": c}


FLOWS = {
    "straight line": (lambda a, b, c: {"x": jnp.sin(a), "y": a + b, "z": jnp.ones(3)}, {"x": "a", "y": "ab", "z": ""}),
    "pytrees": (lambda a, b, c: {"x": (a, {"n": b}), "y": [c]}, {"x": "ab", "y": "c"}),
    "jit": (lambda a, b, c: dict(zip("xy", jax.jit(lambda p, q: (q, p))(a, b), strict=True)), {"x": "b", "y": "a"}),
    "nested jit": (lambda a, b, c: {"x": jax.jit(lambda p: jax.jit(jnp.cos)(p) + c)(b)}, {"x": "bc"}),
    "scan carry": (delay, {"x": "abc", "y": "ac", "z": "ac"}),
    "scan outputs": (
        lambda a, b, c: dict(
            zip("xy", jax.lax.scan(lambda carry, x: (carry + 1, x * b[0]), jnp.sum(c), a), strict=True)
        ),
        {"x": "c", "y": "ab"},
    ),
    "while carry": (while_delay, {"i": "", "x": "ab", "y": "ab", "still": "c"}),
    "while condition": (while_condition, {"x": "abc"}),
    "cond": (branches, {"x": "ac", "y": "abc"}),
    "barrier": (barrier, {"x": "a", "y": "b", "z": "c"}),
    "index": (lambda a, b, c: {"x": a[jnp.argmax(b)], "y": a.at[0].set(c[0])}, {"x": "ab", "y": "ac"}),
    "custom jvp": (lambda a, b, c: {"x": jax.nn.relu(a), "y": jax.nn.logsumexp(b)}, {"x": "a", "y": "b"}),
    "remat": (lambda a, b, c: {"x": jax.checkpoint(lambda p, q: (q, p))(a, b)[0]}, {"x": "b"}),
}  # fmt: skip


@pytest.mark.parametrize("name", FLOWS)
def test_flow_is_exact(name):
    function, expected = FLOWS[name]
    assert outputs_of(function) == expected


def test_a_gradient_carries_what_its_formula_holds_and_stop_gradient_blocks():
    def blocked(a, b, c):
        return {"x": jax.grad(lambda a: jnp.sum(b * a + jax.lax.stop_gradient(a * c)))(a)}

    def open_(a, b, c):
        return {"x": jax.grad(lambda a: jnp.sum(b * a + a * c))(a)}

    def square(a, b, c):
        return {"x": jax.grad(lambda a: jnp.sum(jnp.sin(a) * b))(a)}

    assert outputs_of(blocked) == {"x": "b"}
    assert outputs_of(open_) == {"x": "bc"}
    assert outputs_of(square) == {"x": "ab"}


def test_tags_record_sources_add_and_cuts_replace():
    def tagged(a, b, c):
        x = checkpoint_name(a + b, "middle")
        return {"x": x * c, "y": checkpoint_name(a, "other")}

    plain = flow_of(tagged)
    assert plain.tags == {"middle": {"a", "b"}, "other": {"a"}}
    assert plain.outputs == {"x": {"a", "b", "c"}, "y": {"a"}}
    assert flow_of(tagged, sources=("middle",)).outputs == {"x": {"a", "b", "c", "middle"}, "y": {"a"}}
    cut = flow_of(tagged, sources=("other",), cuts=("middle",))
    assert cut.outputs == {"x": {"c", "middle"}, "y": {"a", "other"}}
    assert cut.tags == plain.tags


def test_a_tag_in_a_loop_sees_what_comes_round():
    def looped(a, b, c):
        def step(x, _):
            x = checkpoint_name(x, "x")
            return x + b, checkpoint_name(2 * c + x, "seen")

        return dict(zip("xy", jax.lax.scan(step, a, None, length=3), strict=True))

    assert flow_of(looped).tags == {"x": {"a", "b"}, "seen": {"a", "b", "c"}}
    cut = flow_of(looped, cuts=("x",))
    assert cut.tags == {"x": {"a", "b", "x"}, "seen": {"c", "x"}}
    assert cut.outputs == {"x": {"a", "b", "x"}, "y": {"c", "x"}}


def test_a_tag_used_twice_holds_both():
    flow = flow_of(lambda a, b, c: {"x": checkpoint_name(a, "t") + checkpoint_name(b, "t")})
    assert flow.tags == {"t": {"a", "b"}}


def test_what_is_not_returned_does_not_count():
    def diagnosed(a, b, c):
        checkpoint_name(a * b, "unused")
        unused = jax.jit(lambda p: checkpoint_name(p, "inside"))(c)
        return {"x": a, "y": jax.jit(lambda p, q: (p, checkpoint_name(q, "dropped")))(a, unused)[0]}

    flow = flow_of(diagnosed)
    assert flow.tags == {}
    assert flow.outputs == {"x": {"a"}, "y": {"a"}}


TABLE = jnp.arange(3.0)
OWNERLESS = {
    "a closure's array": lambda a: a + jax.jit(lambda p: p * TABLE)(a),
    "a constant array": lambda a: a + TABLE,
    "a callback": lambda a: a + jax.pure_callback(lambda: 1.0, jax.ShapeDtypeStruct((), jnp.float32)),
}


@pytest.mark.parametrize("name", OWNERLESS)
def test_what_has_no_owner_is_unknown_unless_a_tag_says_that_it_is_no_data(name):
    found = flow_of(lambda a, b, c: {"x": OWNERLESS[name](a), "y": b, "z": checkpoint_name(OWNERLESS[name](c), KNOWN)})
    assert found.outputs == {"x": {"a", *UNKNOWN}, "y": {"b"}, "z": {"c"}}


def test_what_is_read_from_a_mutable_array_is_unknown():
    def mutable(a, b, c):
        box = jax.new_ref(b)
        box[...] = a
        return {"x": box[...], "y": c}

    found = flow_of(mutable)
    assert found.outputs["x"] >= UNKNOWN
    assert found.outputs["y"] == {"c"}
