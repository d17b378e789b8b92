"""Gaussian elimination with partial pivoting at run time: where the fixed pivot order is not good enough."""

from dirax.engines.native.ir.emitter import Body, Emitter, Module

DENSE_NAME = "dense_solve"


def add_dense_solve(module: Module) -> None:
    """`dense_solve(a, b, x, scratch, k, stride)`: a x = b for (k, k) doubles `stride` apart; scratch holds k (k + 1)."""
    body = Body(module)
    e = Emitter(body, 1)
    width = body.put("add i64 %k, 1")

    def entry(i: str, j: str) -> str:
        return body.at("double", "%scratch", body.put(f"add i64 {body.put(f'mul i64 {i}, {width}')}, {j}"))

    def strided(base: str, index: str) -> str:
        return body.at("double", base, body.put(f"mul i64 {index}, %stride"))

    with body.loop(0, "%k") as i:
        with body.loop(0, "%k") as j:
            number = body.put(f"add i64 {body.put(f'mul i64 {i}, %k')}, {j}")
            body.store("double", body.load("double", strided("%a", number)), entry(i, j))
        body.store("double", body.load("double", strided("%b", i)), entry(i, "%k"))
    best, row = body.alloca("double"), body.alloca("i64")
    with body.loop(0, "%k") as c:
        below = body.put(f"add i64 {c}, 1")
        body.store("double", e.abs(body.load("double", entry(c, c))), best)
        body.store("i64", c, row)
        with body.loop(below, "%k") as i:
            size = e.abs(body.load("double", entry(i, c)))
            with body.when(e.compare("ogt", size, body.load("double", best))):
                body.store("double", size, best)
                body.store("i64", i, row)
        chosen = body.load("i64", row)
        with body.loop(c, width) as j:
            upper, lower = entry(c, j), entry(chosen, j)
            a, b = body.load("double", upper), body.load("double", lower)
            body.store("double", b, upper)
            body.store("double", a, lower)
        pivot = body.load("double", entry(c, c))
        with body.loop(below, "%k") as i:
            factor = e.div(body.load("double", entry(i, c)), pivot)
            with body.loop(below, width) as j:
                product = e.mul(factor, body.load("double", entry(c, j)))
                body.store("double", e.sub(body.load("double", entry(i, j)), product), entry(i, j))
    with body.loop(0, "%k") as back:
        i = body.put(f"sub i64 %k, {body.put(f'add i64 {back}, 1')}")
        total = body.alloca("double")
        body.store("double", body.load("double", entry(i, "%k")), total)
        with body.loop(body.put(f"add i64 {i}, 1"), "%k") as j:
            product = e.mul(body.load("double", entry(i, j)), body.load("double", strided("%x", j)))
            body.store("double", e.sub(body.load("double", total), product), total)
        value = e.div(body.load("double", total), body.load("double", entry(i, i)))
        body.store("double", value, strided("%x", i))
    body.line("ret void")
    module.define(f"define void @{DENSE_NAME}(ptr %a, ptr %b, ptr %x, ptr %scratch, i64 %k, i64 %stride) noinline cold", body)
