"""The learned map from command to effect (phi).

`effect` defines a phi, `residual`, `paper` and `gated` are its variants, which `network` lists and
stores; `collection` and `dataset` make samples of walks, `training` and `nets` fit them.
"""
