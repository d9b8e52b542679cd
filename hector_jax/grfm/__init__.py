"""The learned map from command to effect (phi).

`effect` defines a phi, `residual`, `paper` and `gated` are its variants, which `network` lists and
stores; `dataset` makes samples of walks, `training` and `nets` fit them.
"""
