from .live.live_server import serve_live_view as serve_live_view
from .live.live_session import Session as Session
from .page.drive_page import drive_page as drive_page
from .page.identification_page import identification_report as identification_report
from .page.report_page import report as report
from .sketches.circuit.circuit_drawing import sketch_circuit as sketch_circuit
from .sketches.sketch_figure import sketch as sketch
