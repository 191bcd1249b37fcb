"""pya2l's conversions, for a2l_agrees_with_pya2l.rs.

Takes a JSON list of {"kind", "parameters", "numbers"} on standard input, and prints what the numbers stand for by each.
"""

import json
import sys

from pya2l.functions import Coeffs, CoeffsLinear, Linear, LookupTable, LookupTableWithRanges, RatFunc

MADE_OF = {
    "rational": lambda parameters: RatFunc(Coeffs(*parameters)),
    "linear": lambda parameters: Linear(CoeffsLinear(*parameters)),
    "texts": lambda parameters: LookupTable([(low, text) for low, _, text in parameters], "default"),
    "ranges": lambda parameters: LookupTableWithRanges(parameters, "default"),
}

results = []
for asked in json.load(sys.stdin):
    conversion = MADE_OF[asked["kind"]](asked["parameters"])
    values = [conversion.int_to_physical(number) for number in asked["numbers"]]
    results.append([value if isinstance(value, str) else float(value) for value in values])
print(json.dumps(results))
