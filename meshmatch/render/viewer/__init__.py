"""A page that shows two shapes and the map between them; three.js comes with it (see README.md here)."""

from meshmatch.render.viewer.looks import Looks
from meshmatch.render.viewer.page import PageReport, check_page, write_page
from meshmatch.render.viewer.placement import levelled
from meshmatch.render.viewer.sharing import share_look

__all__ = ["Looks", "PageReport", "check_page", "levelled", "share_look", "write_page"]
