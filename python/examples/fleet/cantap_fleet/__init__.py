"""Traces of a fleet, decoded on a Spark cluster by the package `cantap`.

`inputs` finds the traces and each vehicle's databases, `worker` decodes them where Spark runs it, `dataset` writes the results and
proves that they are complete, `questions` answers questions about them.
"""
