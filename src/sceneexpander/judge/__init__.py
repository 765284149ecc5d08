"""A vision-language model as a judge of what was rendered, by the paper's two criteria, and of candidates for an inserted view.

Modules are imported one by one: most runs have no judge, and to say so needs its settings alone.
"""
