"""One guide per user; the Markdown files beside this module, as one page.

.. include:: renderer.md

.. include:: research.md

.. include:: sweeps.md

.. include:: denoisers.md
"""

__all__: list[str] = []
