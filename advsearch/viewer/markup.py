"""Functions with which experiments make HTML pages: elements, tables and documents; and
`RequestRejected`.

Experiments of other packages use this module through `advsearch.extend`.
`make_element` escapes all text.
"""

from __future__ import annotations

from advsearch.report.views import Html as Html
from advsearch.report.views import join_html as join_html
from advsearch.report.views import make_element as make_element
from advsearch.trust.pages import RequestRejected as RequestRejected
from advsearch.viewer.clients import MAX_BODY_BYTES as MAX_BODY_BYTES
from advsearch.viewer.clients import NO_QR as NO_QR
from advsearch.viewer.clients import make_qr_code as make_qr_code
from advsearch.viewer.document import make_data_script as make_data_script
from advsearch.viewer.document import make_data_url as make_data_url
from advsearch.viewer.document import make_document as make_document
from advsearch.viewer.document import make_header as make_header
from advsearch.viewer.document import make_table as make_table
from advsearch.viewer.document import quote_name as quote_name
from advsearch.viewer.thumbnails import find_thumbnail as find_thumbnail
from advsearch.viewer.thumbnails import find_thumbnails as find_thumbnails
