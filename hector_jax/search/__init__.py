"""Which weights to walk next, from the walks so far.

`few_walks` proposes with a grounded model and a surrogate, where walks are expensive; `cmaes`
searches with thousands.
"""
