"""From views to a camera pose with its uncertainty and a verdict: `pipeline.solve`.

`views` is what goes in, `solution` what comes out, `saving` writes the calibration file, `readers` read files of other
programs.
"""
