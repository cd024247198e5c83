#!/usr/bin/env python3
"""make-stats-fixtures.py: write tests/fixtures/stats.json, what tests/test_stats.c compares with.

    pip install scipy==1.17.1

Run from the root of the tree.  The tests need none of this: the file is committed.
"""
import json

import numpy as np
from scipy.stats import binomtest, bootstrap

rng = np.random.default_rng(5)
sets, coins = [], []
for n, make in ((5, rng.normal), (68, rng.normal), (68, rng.exponential), (34, rng.random)):
    x = make(size=n)
    i = bootstrap((x,), np.mean, n_resamples=200000, method="percentile", rng=1, batch=1000).confidence_interval
    sets.append({"x": list(x), "interval": [i.low, i.high]})
for heads, n in ((0, 1), (5, 10), (8, 10), (3, 11), (40, 68), (510, 1000), (450, 1000), (0, 40)):
    coins.append({"heads": heads, "n": n, "p": binomtest(heads, n).pvalue})
with open("tests/fixtures/stats.json", "w", encoding="utf-8") as f:
    json.dump({"sets": sets, "coins": coins}, f, indent=1)
    f.write("\n")
