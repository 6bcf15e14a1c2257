"""Reading of files and options that come from anywhere: sizes, shapes and types are checked before memory is taken for them.

`boundary` turns whatever goes wrong into one `InputError`; `arrays` reads ``.npz``, ``.npy`` and HDF5, `yaml_text` YAML,
`json_text` JSON. Nothing that is read is ever executed, and no file but the one named is opened.
"""
