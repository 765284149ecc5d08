"""What a picture file says about how it came to be: IPTC's "digital source type", which catalogues, editors and viewers read.

https://cv.iptc.org/newscodes/digitalsourcetype/ ; written as XMP, the one form that PNG and JPEG both have a place for.
"""

from __future__ import annotations

import re
from typing import Final
from xml.sax.saxutils import escape, quoteattr

MADE_BY_MODEL: Final = "trainedAlgorithmicMedia"  # by a trained image generator: "AI-generated"
MADE_FROM_SCENE: Final = "compositeSynthetic"  # rendered from captured photos, with parts that nobody captured
_VOCABULARY = "http://cv.iptc.org/newscodes/digitalsourcetype/"
_FOUND = re.compile(r"cv\.iptc\.org/newscodes/digitalsourcetype/([A-Za-z]{1,40})")


def source_type_xmp(source_type: str, *, credit: str) -> bytes:
    """An XMP packet with the digital source type; ``credit`` names what made the picture."""
    about = quoteattr(f"{_VOCABULARY}{source_type}")
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description rdf:about="" xmlns:Iptc4xmpExt="http://iptc.org/std/Iptc4xmpExt/2008-02-29/" '
        'xmlns:photoshop="http://ns.adobe.com/photoshop/1.0/" '
        f"Iptc4xmpExt:DigitalSourceType={about}><photoshop:Credit>{escape(credit)}</photoshop:Credit></rdf:Description>"
        '</rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
    ).encode()


def read_source_type(xmp: str) -> str | None:
    """The digital source type that a packet states; None without one."""
    found = _FOUND.search(xmp)
    return None if found is None else found[1]
