import sys, time, torch, json

torch.set_num_threads(1)
from worlds import *
from batches import *

settings = eval(f"dict({sys.argv[1]})") if len(sys.argv) > 1 else {}
only = sys.argv[2].split(",") if len(sys.argv) > 2 else ["pendulum", "ground"]
bad = 0
for name, make in (("pendulum", pendulum), ("ground", ground)):
    if name not in only:
        continue
    w = make()
    names = [
        n for n in SITUATIONS if len(sys.argv) < 4 or any(k in n for k in sys.argv[3].split(","))
    ]
    rules = [SITUATIONS[n] for n in names]
    t = time.time()
    alone = play(w, rules, 8, None)
    afm = play(w, rules, 8, flow_for(w, **settings))
    d = afm - alone
    se = d.std(1) / 8**0.5
    for i, n in enumerate(names):
        worse = d[i].mean() > 2 * se[i] and d[i].mean() > 0.02 * alone[i].mean()
        bad += bool(worse)
        print(
            f"{name:9s}{n:26s}{alone[i].mean():9.4f}{afm[i].mean():9.4f} {'WORSE' if worse else ('better' if -d[i].mean() > 2 * se[i] and -d[i].mean() > 0.02 * alone[i].mean() else '')}"
        )
    fr = play(w, [{}, {"noise": 0.05}, {"noise": 0.2}], 8, None, -1.0)
    fa = play(w, [{}, {"noise": 0.05}, {"noise": 0.2}], 8, flow_for(w, **settings), -1.0)
    print(
        name,
        "reversed, n=0 .05 .2: alone",
        fr.mean(1).numpy().round(3),
        "afm",
        fa.mean(1).numpy().round(4),
        f"{time.time() - t:.0f} s",
    )
print("worse", bad)
