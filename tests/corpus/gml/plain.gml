<?xml version="1.0" encoding="utf-8" ?>
<ogr:FeatureCollection
     gml:id="aFeatureCollection"
     xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance"
     xsi:schemaLocation="http://ogr.maptools.org/ plain.xsd"
     xmlns:ogr="http://ogr.maptools.org/"
     xmlns:gml="http://www.opengis.net/gml/3.2">
  <gml:boundedBy><gml:Envelope srsName="urn:ogc:def:crs:EPSG::4326"><gml:lowerCorner>41.1 -8.61</gml:lowerCorner><gml:upperCorner>41.12 -8.6</gml:upperCorner></gml:Envelope></gml:boundedBy>
                                                                                                                                                                
  <ogr:featureMember>
    <ogr:plain gml:id="plain.0">
      <gml:boundedBy><gml:Envelope srsName="urn:ogc:def:crs:EPSG::4326"><gml:lowerCorner>41.1 -8.61</gml:lowerCorner><gml:upperCorner>41.11 -8.61</gml:upperCorner></gml:Envelope></gml:boundedBy>
      <ogr:geometryProperty><gml:LineString srsName="urn:ogc:def:crs:EPSG::4326" gml:id="plain.geom.0"><gml:posList>41.1 -8.61 41.11 -8.61</gml:posList></gml:LineString></ogr:geometryProperty>
      <ogr:highway>residential</ogr:highway>
      <ogr:tunnel xsi:nil="true"/>
      <ogr:name>Rua</ogr:name>
    </ogr:plain>
  </ogr:featureMember>
  <ogr:featureMember>
    <ogr:plain gml:id="plain.1">
      <gml:boundedBy><gml:Envelope srsName="urn:ogc:def:crs:EPSG::4326"><gml:lowerCorner>41.1 -8.605</gml:lowerCorner><gml:upperCorner>41.12 -8.6</gml:upperCorner></gml:Envelope></gml:boundedBy>
      <ogr:geometryProperty><gml:LineString srsName="urn:ogc:def:crs:EPSG::4326" gml:id="plain.geom.1"><gml:posList>41.1 -8.605 41.11 -8.605 41.12 -8.6</gml:posList></gml:LineString></ogr:geometryProperty>
      <ogr:highway>primary</ogr:highway>
      <ogr:tunnel>yes</ogr:tunnel>
      <ogr:name>A</ogr:name>
    </ogr:plain>
  </ogr:featureMember>
  <ogr:featureMember>
    <ogr:plain gml:id="plain.2">
      <gml:boundedBy><gml:Envelope srsName="urn:ogc:def:crs:EPSG::4326"><gml:lowerCorner>41.1 -8.61</gml:lowerCorner><gml:upperCorner>41.1 -8.6</gml:upperCorner></gml:Envelope></gml:boundedBy>
      <ogr:geometryProperty><gml:LineString srsName="urn:ogc:def:crs:EPSG::4326" gml:id="plain.geom.2"><gml:posList>41.1 -8.6 41.1 -8.61</gml:posList></gml:LineString></ogr:geometryProperty>
      <ogr:highway>footway</ogr:highway>
      <ogr:tunnel xsi:nil="true"/>
      <ogr:name></ogr:name>
    </ogr:plain>
  </ogr:featureMember>
  <ogr:featureMember>
    <ogr:plain gml:id="plain.3">
      <gml:boundedBy><gml:Envelope srsName="urn:ogc:def:crs:EPSG::4326"><gml:lowerCorner>41.11 -8.61</gml:lowerCorner><gml:upperCorner>41.11 -8.6</gml:upperCorner></gml:Envelope></gml:boundedBy>
      <ogr:geometryProperty><gml:LineString srsName="urn:ogc:def:crs:EPSG::4326" gml:id="plain.geom.3"><gml:posList>41.11 -8.6 41.11 -8.61</gml:posList></gml:LineString></ogr:geometryProperty>
      <ogr:highway>footway</ogr:highway>
      <ogr:tunnel xsi:nil="true"/>
      <ogr:name></ogr:name>
    </ogr:plain>
  </ogr:featureMember>
</ogr:FeatureCollection>
