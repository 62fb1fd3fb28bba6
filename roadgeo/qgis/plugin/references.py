"""A list of road references to choose from: roadgeo's library, and references that were built outside it."""

from __future__ import annotations

from typing import Any

from processing.gui.wrappers import WidgetWrapper
from qgis.core import QgsProcessingParameterDefinition
from qgis.gui import QgsGui
from qgis.PyQt.QtWidgets import QComboBox, QFileDialog, QHBoxLayout, QToolButton, QWidget

from .library import list_references

__all__ = ["ReferenceWrapper"]


class ReferenceWrapper:
    """Makes the list of references in a dialog; in the modeler QGIS's own, which knows what a model's inputs are."""

    def __new__(cls, param: Any, dialog: Any, row: int = 0, col: int = 0, **more: Any) -> Any:
        """Make it."""
        if type(dialog).__name__ != "ModelerParametersDialog":
            return _Wrapper(param, dialog, row, col, **more)
        registry = QgsGui.processingGuiRegistry()
        wrapper = registry.createModelerParameterWidget(dialog.model, dialog.childId, param, dialog.context)
        wrapper.setDialog(dialog)
        return wrapper


class _Wrapper(WidgetWrapper):
    """An editable list, and a button to choose another file."""

    def createWidget(self) -> Any:
        self.combo = QComboBox()
        self.combo.setEditable(True)
        if self.parameterDefinition().flags() & QgsProcessingParameterDefinition.Flag.FlagOptional:
            self.combo.addItem("All that there are", "")
        for one in list_references():
            self.combo.addItem(
                one.name if one.value == one.name else f"{one.name} ({one.value})",
                one.value,
            )
        self.combo.currentIndexChanged.connect(lambda: self.widgetValueHasChanged.emit(self))
        button, whole, row = QToolButton(), QWidget(), QHBoxLayout()
        button.setText("…")
        button.setToolTip("Choose a file")
        button.clicked.connect(self._browse)
        row.setContentsMargins(0, 0, 0, 0)
        row.addWidget(self.combo, 1)
        row.addWidget(button)
        whole.setLayout(row)
        return whole

    def _browse(self) -> None:
        path, _ = QFileDialog.getOpenFileName(self.combo, "Road reference", "", "Road references (*.gpkg)")
        if path:
            self.setValue(path)

    def setValue(self, value: Any) -> None:
        index = self.combo.findData(value or "")
        if index >= 0:
            self.combo.setCurrentIndex(index)
        elif value:
            self.combo.setEditText(str(value))

    def value(self) -> str:
        text = str(self.combo.currentText()).strip()
        index = self.combo.findText(text)
        return str(self.combo.itemData(index)) if index >= 0 else text
