"""The server's description of itself: the documents of OGC API - Processes, part 1."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from roadgeo import __version__
from roadgeo.matching.hints import HINTS

__all__ = ["DOCUMENTS", "documents_of", "problem"]

_CORE = "http://www.opengis.net/spec/ogcapi-processes-1/1.0/conf"
_CONFORMS = [f"{_CORE}/{part}" for part in ("core", "ogc-process-description", "json", "oas30", "dismiss")]

DOCUMENTS = ("/", "/api", "/conformance", "/processes", "/processes/locate", "/jobs")

#: Hints, as texts or as JSON.
_HINTS: dict[str, dict[str, Any]] = {
    hint.parameter: {"title": hint.told, "schema": {"anyOf": [hint.schema, {"type": "string"}]}}
    for hint in HINTS.values()
}


def documents_of(references: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return each document by its path."""
    # The one process: its inputs and outputs.
    summary = {
        "id": "locate",
        "title": "Locate a road mask or a photograph",
        "description": "Finds where an aerial image was taken from its roads alone, on " + ", ".join(references) + ".",
        "version": __version__,
        "jobControlOptions": ["sync-execute", "async-execute", "dismiss"],
        "outputTransmission": ["value"],
        "links": [_link("/processes/locate", "self", "this process")],
    }
    image = {
        "title": "The mask or photograph, base64",
        "schema": {"type": "string", "contentEncoding": "base64", "contentMediaType": "image/*"},
        "minOccurs": 1,
        "maxOccurs": 1,
    }
    hints = {name: {**hint, "minOccurs": 0, "maxOccurs": 1} for name, hint in _HINTS.items()}
    location = {"title": "The answer, schema roadgeo.location/1", "schema": {"type": "object"}}
    # All documents; the paths are those of OGC API Processes.
    return {
        "/": {
            "title": "roadgeo",
            "description": "Locates aerial images from their roads alone.",
            "links": [
                _link("/", "self", "this document"),
                _link("/api", "service-desc", "the API", "application/vnd.oai.openapi+json;version=3.0"),
                _link("/conformance", "http://www.opengis.net/def/rel/ogc/1.0/conformance", "what it conforms to"),
                _link("/processes", "http://www.opengis.net/def/rel/ogc/1.0/processes", "processes"),
                _link("/jobs", "http://www.opengis.net/def/rel/ogc/1.0/job-list", "jobs"),
                _link("/health", "monitor", "whether it answers"),
            ],
        },
        "/conformance": {"conformsTo": _CONFORMS},
        "/api": _api(),
        "/processes": {"processes": [summary], "links": [_link("/processes", "self", "processes")]},
        "/processes/locate": {
            **summary,
            "inputs": {"image": image, **hints},
            "outputs": {"location": location},
            "links": [
                *summary["links"],
                _link("/processes/locate/execution", "http://www.opengis.net/def/rel/ogc/1.0/execute", "run it"),
            ],
        },
        "/jobs": {"jobs": [], "links": [_link("/jobs", "self", "a job is known to who asked for it; none is listed")]},
    }


def problem(status: int, title: str, detail: str) -> dict[str, Any]:
    """Return an error as a document of RFC 7807."""
    return {"type": "about:blank", "status": status, "title": title, "detail": detail}


def _link(href: str, rel: str, title: str, media: str = "application/json") -> dict[str, str]:
    return {"href": href, "rel": rel, "type": media, "title": title}


def _api() -> dict[str, Any]:
    """Return the API in OpenAPI 3.0, in short."""
    answer = {"200": {"description": "the answer", "content": {"application/json": {"schema": {"type": "object"}}}}}
    busy = {"503": {"description": "as many requests as may be are waiting; Retry-After says when to come again"}}
    binary = {"schema": {"type": "string", "format": "binary"}}
    parameters: list[dict[str, Any]] = [{"name": name, "in": "query", "schema": {"type": "string"}} for name in _HINTS]
    prefer = {"name": "Prefer", "in": "header", "schema": {"type": "string", "enum": ["respond-async"]}}
    created = {"201": {"description": "with Prefer: respond-async, a job; Location says where it stands"}}
    answers = {**answer, **created, **busy}
    form = {"type": "object", "properties": {"image": {"type": "string", "format": "binary"}}, "required": ["image"]}
    paths: dict[str, Any] = {path: {"get": {"responses": answer}} for path in (*DOCUMENTS, "/health")}
    paths["/locate"] = {
        "post": {
            "summary": "Locate the image that is the body, or a file of a form",
            "parameters": [*parameters, prefer],
            "requestBody": {
                "required": True,
                "content": {
                    "image/*": binary,
                    "application/octet-stream": binary,
                    "multipart/form-data": {"schema": form},
                },
            },
            "responses": answers,
        }
    }
    paths["/processes/locate/execution"] = {
        "post": {
            "summary": "Locate an image",
            "parameters": [prefer],
            "requestBody": {"required": True, "content": {"application/json": {"schema": {"type": "object"}}}},
            "responses": answers,
        }
    }
    job = [{"name": "jobID", "in": "path", "required": True, "schema": {"type": "string"}}]
    paths["/jobs/{jobID}"] = {
        "parameters": job,
        "get": {"summary": "How far a job is", "responses": answer},
        "delete": {"summary": "Call it off, and forget it", "responses": answer},
    }
    paths["/jobs/{jobID}/results"] = {"parameters": job, "get": {"responses": answer}}
    stream = {"200": {"description": "its states as they change", "content": {"text/event-stream": {}}}}
    paths["/jobs/{jobID}/events"] = {"parameters": job, "get": {"responses": stream}}
    return {"openapi": "3.0.3", "info": {"title": "roadgeo", "version": __version__}, "paths": paths}
