import sys, time, torch

torch.set_num_threads(1)
from worlds import *
from batches import *
from collections import OrderedDict

SUB = dict(
    p=["gust 0.3", "noise 0.05", "noise 0.2", "noise 0.5", "gravity x 1.2", "length x 1.3"],
    g=[
        "gust 0.3",
        "gust 1",
        "noise 0.05",
        "noise 0.2",
        "noise 0.5",
        "friction 0.3, noise 0.05",
        "stale 20 %",
    ],
)
SEEDS = int(sys.argv[1])
base = {}
for r, make in (("p", pendulum), ("g", ground)):
    w = make()
    rules = [SITUATIONS[n] for n in SUB[r]]
    base[r] = (
        w,
        rules,
        play(w, rules, SEEDS, None).mean(1),
        play(w, [{}, {"noise": 0.05}, {"noise": 0.2}], SEEDS, None, -1.0).mean(1),
    )
    print(r, "alone", base[r][2].numpy().round(4), "reversed", base[r][3].numpy().round(3))
    print("   ", SUB[r])
for s in sys.argv[2:]:
    settings = eval(f"dict({s})")
    t = time.process_time()
    print("==", s, end=" ")
    for r in "pg":
        w, rules, alone, _ = base[r]
        a = play(w, rules, SEEDS, flow_for(w, **settings)).mean(1)
        f = play(
            w, [{}, {"noise": 0.05}, {"noise": 0.2}], SEEDS, flow_for(w, **settings), -1.0
        ).mean(1)
        print(r, (a / alone).numpy().round(2), "rev", f.numpy().round(3), end=" ")
    print(f"{time.process_time() - t:.0f}s", flush=True)
