"""A page that shows two shapes and the map between them; three.js comes with it (see README.md here)."""

from meshmatch.render.viewer.assembly import check_page
from meshmatch.render.viewer.looks import Looks, share_look
from meshmatch.render.viewer.page import PageReport, write_page

__all__ = ["Looks", "PageReport", "check_page", "share_look", "write_page"]
