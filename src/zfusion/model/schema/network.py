"""How a scenario writes its graph: a matrix, a list of edges, or a rule that generates one."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from typing import Annotated, Literal

from pydantic import Discriminator, Field, Tag

from zfusion.errors import Problem
from zfusion.model.network import Network, edge_faults, matrix_faults
from zfusion.model.schema.base import Count, Flag, Id, Matrix, Natural, Positive, Spec, shortest
from zfusion.model.types import NodeId, sorted_ids

Ids = tuple[NodeId, ...]


class Graph(Spec):
    """Any description of a graph on the sensors, given by their ids in the order in which the scenario lists them."""

    @abstractmethod
    def network(self, ids: Ids) -> Network:
        """The graph; ValueError if this describes none on these ids."""

    def problems(self, ids: Ids) -> Iterator[Problem]:
        """All that keeps this from being a graph on these ids; fields are relative to this piece."""
        try:
            self.network(ids)
        except ValueError as error:
            yield Problem("", self.model_dump(exclude_unset=True), str(error))


class MatrixGraph(Graph):
    """a_ij > 0: i receives from j. Rows and columns are in the order of `ids`, or else of the sensors."""

    matrix: Matrix
    ids: tuple[Id, ...] | None = None
    """Needed where the sensors are not listed in the order of their ids, lest anybody guess."""

    def network(self, ids: Ids) -> Network:
        """See `Graph`."""
        return Network.from_matrix(self.ids or ids, self.matrix)

    def problems(self, ids: Ids) -> Iterator[Problem]:
        """See `Graph`."""
        if self.ids is None and list(ids) != sorted_ids(ids):
            yield Problem("ids", None, "required, as the sensors are not listed in the order of their ids")
        if self.ids is not None and (set(self.ids) != set(ids) or len(self.ids) != len(ids)):
            yield Problem("ids", list(self.ids), "expected the id of every sensor, once")
        for at, fault in matrix_faults(len(ids), self.matrix):
            value = self.matrix[at[0]][at[1]] if at else shortest(self.matrix)
            yield Problem("matrix" + "".join(f"[{n}]" for n in at), value, fault)


class EdgesGraph(Graph):
    """An arrow for each [from, to]: the second receives from the first, and back again if `undirected`."""

    edges: tuple[tuple[Id, Id], ...]
    undirected: Flag = False

    def network(self, ids: Ids) -> Network:
        """See `Graph`."""
        return Network.from_edges(ids, self.edges, self.undirected)

    def problems(self, ids: Ids) -> Iterator[Problem]:
        """See `Graph`."""
        for index, fault in edge_faults(ids, self.edges, self.undirected):
            yield Problem(f"edges[{index}]", list(self.edges[index]), fault)


class GeneratedGraph(Graph):
    """A graph made by a rule."""

    TAG = "generator"


class CompleteGraph(GeneratedGraph):
    """Everybody receives from everybody."""

    generator: Literal["complete"] = "complete"

    def network(self, ids: Ids) -> Network:
        """See `Graph`."""
        return Network.complete(ids)


class RingGraph(GeneratedGraph):
    """Each sends to the next `reach` round the ring, and hears them too unless `directed`."""

    generator: Literal["ring"] = "ring"
    reach: Count = 1
    directed: Flag = False

    def network(self, ids: Ids) -> Network:
        """See `Graph`."""
        return Network.ring(ids, self.reach, self.directed)


class LineGraph(GeneratedGraph):
    """Each sends to the next, and hears it too unless `directed`."""

    generator: Literal["line"] = "line"
    directed: Flag = False

    def network(self, ids: Ids) -> Network:
        """See `Graph`."""
        return Network.line(ids, self.directed)


class StarGraph(GeneratedGraph):
    """The hub, by default the first node, and each of the others hear each other."""

    generator: Literal["star"] = "star"
    hub: Id | None = None

    def network(self, ids: Ids) -> Network:
        """See `Graph`."""
        return Network.star(ids, self.hub)


class GridGraph(GeneratedGraph):
    """Row by row on a grid, by default as square as can be."""

    generator: Literal["grid"] = "grid"
    columns: Count | None = None

    def network(self, ids: Ids) -> Network:
        """See `Graph`."""
        return Network.grid(ids, self.columns)


class RandomGeometricGraph(GeneratedGraph):
    """At random in the unit square; those at most `radius` apart hear each other."""

    generator: Literal["random_geometric"] = "random_geometric"
    radius: Positive
    seed: Natural = 0

    def network(self, ids: Ids) -> Network:
        """See `Graph`."""
        return Network.random_geometric(ids, self.radius, self.seed)


class RandomRegularGraph(GeneratedGraph):
    """At random, each with `degree` others that it hears and that hear it."""

    generator: Literal["random_regular"] = "random_regular"
    degree: Natural
    seed: Natural = 0

    def network(self, ids: Ids) -> Network:
        """See `Graph`."""
        return Network.random_regular(ids, self.degree, self.seed)


Generated = Annotated[
    CompleteGraph | RingGraph | LineGraph | StarGraph | GridGraph | RandomGeometricGraph | RandomRegularGraph,
    Field(discriminator="generator"),
]


def _form(value: object) -> str | None:
    """Which of the three forms of description it is."""
    for form in ("matrix", "edges", "generator"):
        if (isinstance(value, Mapping) and form in value) or hasattr(value, form):
            return f"<{form}>"
    return None


AnyGraph = Annotated[
    Annotated[MatrixGraph, Tag("<matrix>")]
    | Annotated[EdgesGraph, Tag("<edges>")]
    | Annotated[Generated, Tag("<generator>")],
    Discriminator(
        _form,
        custom_error_type="no_form",
        custom_error_message="expected one of matrix = [[..], ..], edges = [[from, to], ..] and generator = '..'",
    ),
]
