"""The HTML reports' one environment: templates beside the code that fills them, every value escaped."""

import functools
from typing import Any

import jinja2


@functools.cache
def _environment() -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.PackageLoader("twostage_servo", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def page(template: str, **values: Any) -> str:
    """Return a page.

    Parameters
    ----------
    template
        Path of the template below this package, such as ``faults/report.html.jinja``.
    values
        What it shows. Texts are escaped, but for those that are :class:`markupsafe.Markup`; a name that the template
        uses and that is missing here is an error.
    """
    return _environment().get_template(template).render(values)
