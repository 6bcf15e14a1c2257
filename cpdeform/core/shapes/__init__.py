"""The shapes of tools and bodies, one file a kind, with all that anybody asks of them.

A file holds a `Shape` (signed distance, half extents, surface, volume, sample) and the models of the scene that have it: a
`ToolBase`, a `BodyBase`, or both. `cpdeform.core.shapes.kinds` lists the models. A new kind is a new file and an entry
there; simulators run it once their kernels know it and their capabilities say so.
"""
