"""HTML of pages that experiments make: elements, tables, documents, and `Refused`.

`advsearch.extend` offers this module to added experiments. Text becomes markup only
through `element`, which escapes it.
"""

from __future__ import annotations

from advsearch.report.views import Html as Html
from advsearch.report.views import element as element
from advsearch.report.views import join_html as join_html
from advsearch.trust.pages import Refused as Refused
from advsearch.viewer.clients import LARGEST_SENT as LARGEST_SENT
from advsearch.viewer.clients import NO_QR as NO_QR
from advsearch.viewer.clients import qr_code as qr_code
from advsearch.viewer.document import data_script as data_script
from advsearch.viewer.document import data_url as data_url
from advsearch.viewer.document import document as document
from advsearch.viewer.document import heading as heading
from advsearch.viewer.document import in_address as in_address
from advsearch.viewer.document import study_table as study_table
from advsearch.viewer.thumbnails import kept_file as kept_file
from advsearch.viewer.thumbnails import kept_pictures as kept_pictures
