"""A result as one HTML page for an engineer: verdict, figures, tables, and how to get the numbers again.

    from kf_calib.report.contents import page_of
    from kf_calib.report.page import save

    measured = Measured("run.mcap", sha256, began)
    save(page_of(found, [measured], ["kf-calib report run.mcap"]), Path("report.html"))

The page holds all that it needs, and asks the network for nothing: figures as SVG, the residual explorer with uPlot.
"""
