"""The interface in other languages. Texts that a table lacks, and messages of the engine, stay English.

Blender looks up labels, tooltips and names of properties by itself: a language is a table from English texts to others.
"""

import bpy

from . import EXTENSION, WORDS

GERMAN = {
    "Scene": "Szene",
    "Check": "Prüfen",
    "Find Cameras": "Kameras finden",
    "Find Cameras of These Photos": "Kameras dieser Fotos finden",
    "Find out from which place each photo was taken, and import the cameras": (
        "Bestimmen, von wo jedes Foto aufgenommen wurde, und die Kameras importieren"
    ),
    "Choose a folder of photos or a video; from which place each photo was taken is read, or found out": (
        "Einen Ordner mit Fotos oder ein Video wählen; von wo jedes Foto aufgenommen wurde, wird gelesen oder bestimmt"
    ),
    "Choose a folder of photos or a video, or open a run in Result.": (
        "Einen Ordner mit Fotos oder ein Video wählen, oder unter Ergebnis einen Lauf öffnen."
    ),
    "Photos or Video": "Fotos oder Video",
    "Folder of photos, one of its photos, or a video": "Ordner mit Fotos, eines dieser Fotos oder ein Video",
    "Scene Folder": "Szenenordner",
    "New folder for copies of the photos and their cameras; empty: beside the photos or video": (
        "Neuer Ordner für Kopien der Fotos und ihre Kameras; leer: neben den Fotos oder dem Video"
    ),
    "Sparse Points": "Punktwolke",
    "Import Cameras": "Kameras importieren",
    "Cameras of Another Program": "Kameras eines anderen Programms",
    "Cameras of Another Program (.xml/.json/.csv)": "Kameras eines anderen Programms (.xml/.json/.csv)",
    "Make a scene of cameras that Metashape, RealityScan, nerfstudio or another program has found, and import it": (
        "Aus Kameras, die Metashape, RealityScan, nerfstudio oder ein anderes Programm bestimmt hat, eine Szene machen "
        "und importieren"
    ),
    "File with the cameras, such as the XML of Metashape or transforms.json": (
        "Datei mit den Kameras, etwa das XML von Metashape oder transforms.json"
    ),
    "Folder with the photos of these cameras; empty: the folder of the file": (
        "Ordner mit den Fotos dieser Kameras; leer: der Ordner der Datei"
    ),
    "PLY file of points in the coordinates of the cameras; empty: those of the file or the photos": (
        "PLY-Datei mit Punkten in den Koordinaten der Kameras; leer: Punkte der Datei oder der Fotos"
    ),
    "New folder for copies of the photos and their cameras; empty: beside the file": (
        "Neuer Ordner für Kopien der Fotos und ihre Kameras; leer: neben der Datei"
    ),
    "Import": "Importieren",
    "Import COLMAP Scene": "COLMAP-Szene importieren",
    "Effects": "Effekte",
    "Plan": "Planen",
    "Plan Again": "Neu planen",
    "Plan Effects": "Effekte planen",
    "Follow Plan": "Plan folgen",
    "On": "Ein",
    "Off": "Aus",
    "How Good Is It?": "Wie gut ist es?",
    "Excellent": "Sehr gut",
    "Good": "Gut",
    "Fair": "Mittel",
    "Poor": "Schlecht",
    "{word}: {psnr} dB on photos it never saw.": "{word}: {psnr} dB auf Fotos, die das Training nicht kannte.",
    "Close to the photos, at the size of the training.": "Nahe an den Fotos, in der Größe des Trainings.",
    "Open Another": "Weiteres öffnen",
    "Shapes and colors are those of the photos; fine detail is softer.": (
        "Formen und Farben entsprechen den Fotos; feine Details sind weicher."
    ),
    "Large shapes are right; detail is lost. More photos of places that few show help.": (
        "Große Formen stimmen; Details fehlen. Mehr Fotos von Stellen, die wenige zeigen, helfen."
    ),
    "Check that the photos overlap and that their cameras fit.": (
        "Prüfen, ob die Fotos sich überlappen und ihre Kameras stimmen."
    ),
    "Water Values": "Werte des Wassers",
    "Clean Up": "Aufräumen",
    "Finish Clean Up": "Aufräumen beenden",
    "Select floaters, blobs in open water and the fuzzy border, and compute what removing them costs": (
        "Floater, Flecken im freien Wasser und den unscharfen Rand auswählen und berechnen, was das Entfernen kostet"
    ),
    "Delete the selected splats, or keep them, and end the proposal of Clean Up": (
        "Die ausgewählten Splats löschen oder behalten und den Vorschlag von Aufräumen beenden"
    ),
    "Delete the selected splats instead of deselecting them": (
        "Die ausgewählten Splats löschen, statt ihre Auswahl aufzuheben"
    ),
    "Press Clean Up first": "Zuerst Aufräumen drücken",
    "Floaters": "Floater",
    "Splats in front of the surfaces that the photos show": "Splats vor den Oberflächen, die die Fotos zeigen",
    "Open Water": "Freies Wasser",
    "Splats that stand for the haze of open water": "Splats, die für den Dunst freien Wassers stehen",
    "Fuzzy Border": "Unscharfer Rand",
    "Large, faint splats where few photos look": "Große, blasse Splats, wohin wenige Fotos blicken",
    "{registered} of {images} photos have a camera, {points} points": (
        "{registered} von {images} Fotos haben eine Kamera, {points} Punkte"
    ),
    "field of view {angle}° (focal length {length})": "Blickfeld {angle}° (Brennweite {length})",
    "the most frequent of {count} lenses": "das häufigste von {count} Objektiven",
    "masks for {count} photos": "Masken für {count} Fotos",
    "drift {fraction} of the path": "Drift {fraction} des Weges",
    "Face Camera": "Zur Kamera",
    "Takes about {cost} ms of an iteration on this machine.": (
        "Braucht etwa {cost} ms eines Schritts auf diesem Rechner."
    ),
    "Without the selected splats the held-out PSNR is {after} dB instead of {before} dB ({difference} dB, {views} "
    "photos).": (
        "Ohne die ausgewählten Splats ist der PSNR auf {views} Fotos, die das Training nicht kannte, {after} dB statt "
        "{before} dB ({difference} dB)."
    ),
    "Train": "Trainieren",
    "Continue": "Fortsetzen",
    "Pause": "Anhalten",
    "Cancel": "Abbrechen",
    "Show Log": "Protokoll zeigen",
    "Method": "Verfahren",
    "Quality": "Güte",
    "Time Budget": "Zeitrahmen",
    "Iterations": "Schritte",
    "Width": "Breite",
    "Max Gaussians": "Max. Splats",
    "Water": "Wasser",
    "Metres per Unit": "Meter je Einheit",
    "SH Degree": "SH-Grad",
    "Result": "Ergebnis",
    "Set Up Render": "Rendern vorbereiten",
    "Open Splat File": "Splat-Datei",
    "Labels": "Etiketten",
    "Export": "Exportieren",
    "Install Engine": "Rechenkern einrichten",
    "Install Engine Again": "Rechenkern neu einrichten",
    "Remove Engine": "Rechenkern entfernen",
    "Check Engine": "Rechenkern prüfen",
    "Look Up Size": "Größe nachsehen",
    "Package Index": "Paketverzeichnis",
    "Folder of Wheels": "Ordner mit Wheels",
    "Open Preferences": "Einstellungen öffnen",
    "As splat viewers show the file: a PLY has its y axis down, a GLB or SPZ its y axis up": (
        "Wie Splat-Betrachter die Datei zeigen: Im PLY zeigt die y-Achse nach unten, im GLB und SPZ nach oben"
    ),
    "Axes": "Achsen",
    "Backend": "Rechenweg",
    "Blender's up is up in other programs: y down in a PLY, y up in a GLB or SPZ": (
        "Was in Blender oben ist, ist es auch in anderen Programmen: y nach unten im PLY, nach oben im GLB und SPZ"
    ),
    "COLMAP Scene (folder)": "COLMAP-Szene (Ordner)",
    "Cameras": "Kameras",
    "Choice": "Wahl",
    "Click two points of the splats whose distance you know; the scene is then scaled by it": (
        "Zwei Punkte der Splats anklicken, deren Abstand bekannt ist; danach wird die Szene skaliert"
    ),
    "Color": "Farbe",
    "Cost": "Kosten",
    "Crop Box": "Ausschnitt",
    "Delete the engine's Python environment with all its packages; runs and splats stay": (
        "Die Python-Umgebung des Rechenkerns mit allen Paketen löschen; Läufe und Splats bleiben"
    ),
    "Display": "Anzeige",
    "Distance": "Abstand",
    "Download the packages that training needs into a Python environment of their own": (
        "Die Pakete, die das Training braucht, in eine eigene Python-Umgebung laden"
    ),
    "Effect": "Effekt",
    "Engine": "Renderer",
    "Export Gaussian Splats": "Gauß-Splats exportieren",
    "Extend": "Erweitern",
    "Folder": "Ordner",
    "Folder of the masks": "Ordner der Masken",
    "Forecast": "Vorhersagen",
    "Gaussian Splats": "Gauß-Splats",
    "Gaussians": "Gaußglocken",
    "Import Gaussian Splats": "Gauß-Splats importieren",
    "Interrupted": "Abgebrochen",
    "Isolate": "Freistellen",
    "Label": "Etikettieren",
    "Length of one Blender unit in metres; the file is in metres": (
        "Länge einer Blender-Einheit in Metern; die Datei ist in Metern"
    ),
    "List the labels of the splats, with the names of the run they are from": (
        "Die Etiketten der Splats auflisten, mit den Namen ihres Laufs"
    ),
    "Look Up Size of Engine": "Größe des Rechenkerns nachsehen",
    "Make Labels": "Etiketten machen",
    "Mask": "Maske",
    "Masks": "Masken",
    "Merge": "Vereinen",
    "Merge Splats": "Splats vereinen",
    "Milliseconds that the effect adds to an iteration here": (
        "Millisekunden, die der Effekt hier zu einem Schritt hinzufügt"
    ),
    "Mix the color of its label into each splat": "Jedem Splat die Farbe seines Etiketts beimischen",
    "Name": "Name",
    "Node Groups as Assets": "Knotengruppen als Assets",
    "Objects": "Objekte",
    "Only splats of at least this opacity": "Nur Splats von mindestens dieser Deckkraft",
    "Only splats with these labels, by name or number; all splats where none is given (separated by commas)": (
        "Nur Splats mit diesen Etiketten, nach Name oder Nummer; alle Splats, wenn keines genannt ist (durch Kommas "
        "getrennt)"
    ),
    "Open Gaussian splats from PLY, GLB or SPZ files": "Gauß-Splats aus PLY-, GLB- oder SPZ-Dateien öffnen",
    "Open the engine's log of the last job in a text editor, at its end": (
        "Das Ende vom Protokoll des letzten Auftrags des Rechenkerns in einem Texteditor zeigen"
    ),
    "Pick Two Points": "Zwei Punkte",
    "Python": "Python",
    "Read Labels": "Etiketten lesen",
    "Remove": "Entfernen",
    "Save splat objects as one PLY, GLB or SPZ file, their transforms and modifiers applied": (
        "Splat-Objekte als eine PLY-, GLB- oder SPZ-Datei speichern, Transformationen und Modifikatoren angewandt"
    ),
    "Scale the scene by the distance between two selected objects, such as cameras, or two points": (
        "Die Szene nach dem Abstand zweier gewählter Objekte, etwa Kameras, oder zweier Punkte skalieren"
    ),
    "Search": "Suchen",
    "Search Splats": "Splats suchen",
    "Seconds": "Sekunden",
    "Seed": "Startwert",
    "Select Label": "Etikett wählen",
    "Select an object with splats first.": "Zuerst ein Objekt mit Splats wählen.",
    "Selected": "Gewählte",
    "Separate": "Trennen",
    "Separate Splats": "Splats trennen",
    "50 targets of 4 x 4 cells: few cells, so that they are read from far away and in murky water": (
        "50 Zielmarken mit 4 x 4 Feldern: wenige Felder, sodass sie von weitem und in trübem Wasser gelesen werden"
    ),
    "100 targets of 4 x 4 cells": "100 Zielmarken mit 4 x 4 Feldern",
    "250 targets of 4 x 4 cells": "250 Zielmarken mit 4 x 4 Feldern",
    "1000 targets of 4 x 4 cells": "1000 Zielmarken mit 4 x 4 Feldern",
    "50 targets of 5 x 5 cells": "50 Zielmarken mit 5 x 5 Feldern",
    "100 targets of 5 x 5 cells": "100 Zielmarken mit 5 x 5 Feldern",
    "250 targets of 5 x 5 cells": "250 Zielmarken mit 5 x 5 Feldern",
    "1000 targets of 5 x 5 cells": "1000 Zielmarken mit 5 x 5 Feldern",
    "50 targets of 6 x 6 cells": "50 Zielmarken mit 6 x 6 Feldern",
    "100 targets of 6 x 6 cells": "100 Zielmarken mit 6 x 6 Feldern",
    "250 targets of 6 x 6 cells": "250 Zielmarken mit 6 x 6 Feldern",
    "1000 targets of 6 x 6 cells": "1000 Zielmarken mit 6 x 6 Feldern",
    "50 targets of 7 x 7 cells": "50 Zielmarken mit 7 x 7 Feldern",
    "100 targets of 7 x 7 cells": "100 Zielmarken mit 7 x 7 Feldern",
    "250 targets of 7 x 7 cells": "250 Zielmarken mit 7 x 7 Feldern",
    "1000 targets of 7 x 7 cells": "1000 Zielmarken mit 7 x 7 Feldern",
    "1024 targets of the first ArUco library": "1024 Zielmarken der ersten ArUco-Bibliothek",
    "250 targets of 6 x 6 cells that are hard to confuse": (
        "250 Zielmarken mit 6 x 6 Feldern, die schwer zu verwechseln sind"
    ),
    "30 AprilTags of 4 x 4 cells": "30 AprilTags mit 4 x 4 Feldern",
    "35 AprilTags of 5 x 5 cells": "35 AprilTags mit 5 x 5 Feldern",
    "2320 AprilTags of 6 x 6 cells": "2320 AprilTags mit 6 x 6 Feldern",
    "587 AprilTags of 6 x 6 cells, the most common ones": "587 AprilTags mit 6 x 6 Feldern, die üblichsten",
    "Scale from Targets": "Maßstab aus Zielmarken",
    "Find coded targets (ArUco, AprilTag) of known size in the photos, and scale the scene to metres by them": (
        "Kodierte Zielmarken (ArUco, AprilTag) bekannter Größe in den Fotos finden und die Szene danach auf Meter "
        "skalieren"
    ),
    "Targets": "Zielmarken",
    "Family that the targets belong to": "Familie, zu der die Zielmarken gehören",
    "Edge Length (m)": "Kantenlänge (m)",
    "Length of an edge of the black square of a target, in metres": (
        "Länge einer Kante des schwarzen Quadrats einer Zielmarke in Metern"
    ),
    "Georeferenced": "Georeferenziert",
    "Metric frame of the measured scale: metres with z up, with offset and coordinate reference system": (
        "Metrisches System des gemessenen Maßstabs: Meter, z nach oben, mit Versatz und Koordinatenreferenzsystem"
    ),
    "The length of a unit is not known.": "Die Länge einer Einheit ist nicht bekannt.",
    "The scene is shown {factor} times as large as its coordinates.": (
        "Die Szene wird {factor}-mal so groß gezeigt wie ihre Koordinaten."
    ),
    "Import the scene first; where there are several, select one of them": (
        "Zuerst die Szene importieren; wo es mehrere gibt, eine davon auswählen"
    ),
    "Scale": "Maßstab",
    "Set Scale": "Maßstab setzen",
    "Show All": "Alle zeigen",
    "Show Colors": "Farben zeigen",
    "Show Uncertain Colors": "Unsichere Farben",
    "Mix pink into splats of which too little light reached the camera to know their color without water": (
        "Splats rosa färben, von denen zu wenig Licht die Kamera erreichte, um ihre Farbe ohne Wasser zu kennen"
    ),
    "Show all labels": "Alle Etiketten zeigen",
    "Show the splats with this label": "Die Splats mit diesem Etikett zeigen",
    "Splats of the last run": "Splats des letzten Laufs",
    "Splats with this label": "Splats mit diesem Etikett",
    "The selected splat objects": "Die gewählten Splat-Objekte",
    "Renders are Blender's own: noisy with few samples, and lighter where splats overlap, because Blender blends light "
    "and training blended display values. Exact Shapes renders them as trained.": (
        "Blender rendert selbst: mit wenigen Samples verrauscht, und heller, wo Splats sich überlagern, weil Blender "
        "Licht mischt und das Training Anzeigewerte. Genaue Formen rendert sie wie trainiert."
    ),
    "These splats have no water. It comes with the run that trained them: press Open Run in Result.": (
        "Diese Splats haben kein Wasser. Es kommt mit dem Lauf, der sie trainiert hat: unter Ergebnis Lauf öffnen."
    ),
    "Blender now draws these splats itself: {names}. Undo brings back the earlier nodes; Exact Shapes in the panel "
    "Display draws them as before.": (
        "Blender zeichnet diese Splats jetzt selbst: {names}. Rückgängig bringt die früheren Knoten zurück; Genaue "
        "Formen im Panel Anzeige zeichnet sie wie zuvor."
    ),
    "Blender 5.3 or later saved these splats, and this version of Blender cannot read their colors: {names}. Open "
    "the file in Blender 5.2 or later, or export the splats there as PLY.": (
        "Blender 5.3 oder neuer hat diese Splats gespeichert, und diese Version kann ihre Farben nicht lesen: {names}. "
        "Die Datei in Blender 5.2 oder neuer öffnen oder die Splats dort als PLY exportieren."
    ),
    "Exact Shapes": "Genaue Formen",
    "Render the extension's own shapes: without noise, as trained if set up so, and slower": (
        "Die eigenen Formen der Erweiterung rendern: ohne Rauschen, wie trainiert, wenn so eingerichtet, und langsamer"
    ),
    "Blender's Splats": "Blenders Splats",
    "Blender's own drawing: with noise, and dark in Solid shading": (
        "Blenders eigene Darstellung: mit Rauschen, und dunkel in der Schattierung Solid"
    ),
    "Threshold": "Schwelle",
    "Upright": "Aufrecht",
    "Visible": "Sichtbar",
    "What to label, as in coral, wreck, open water": "Was zu etikettieren ist, wie in coral, wreck, open water",
    "What to look for, such as coral": "Was zu suchen ist, etwa coral",
    "No job has written a log yet": "Noch hat nichts ein Protokoll geschrieben",
    "Nothing differs from the plan": "Nichts weicht vom Plan ab",
    "No training is running": "Es läuft kein Training",
    "There are no splats in the scene": "In der Szene sind keine Splats",
    "Select an object with splats first": "Zuerst ein Objekt mit Splats auswählen",
    "Words": "Worte",
    "Y Up": "Y oben",
    "Z Up": "Z oben",
    "Water Type": "Wassertyp",
    "Which method trains the scene (docs/recipes.md)": "Welches Verfahren die Szene trainiert (docs/recipes.md)",
    "Models the water and the effects that the scene calls for, and removes them": (
        "Modelliert das Wasser und die Effekte, die die Szene verlangt, und entfernt sie"
    ),
    "Plain Gaussian splatting: the scene as photographed": ("Einfaches Gaussian Splatting: die Szene wie fotografiert"),
    "Follows SeaSplat": "Folgt SeaSplat",
    "Follows UW-GS": "Folgt UW-GS",
    "Follows WaterSplatting": "Folgt WaterSplatting",
    "Follows RUSplatting": "Folgt RUSplatting",
    "Follows SWAGSplatting as published": "Folgt SWAGSplatting wie veröffentlicht",
    "How long to train and at which size": "Wie lange und in welcher Größe trainiert wird",
    "To see whether a scene works": "Um zu sehen, ob eine Szene geht",
    "A good result in moderate time": "Ein gutes Ergebnis in mäßiger Zeit",
    "For a result to keep": "Für ein Ergebnis, das bleibt",
    "End early when a fifth of the run has improved the validation PSNR by less than 0.05 dB": (
        "Früher enden, wenn ein Fünftel des Laufs das PSNR der Prüffotos um weniger als 0,05 dB verbessert hat"
    ),
    "What to label while training with semantics on, such as coral, wreck, open water; needs pretrained networks": (
        "Was beim Training mit dem Effekt Semantik zu etikettieren ist, wie coral, wreck, open water; braucht "
        "vortrainierte Netze"
    ),
    (
        "Folder of mask images to label by instead of words; without both, masks in the scene's folder labels are"
        " used, or else saliency"
    ): (
        "Ordner mit Maskenbildern statt Worten; ohne beides gelten Masken im Ordner labels der Szene, sonst die "
        "Auffälligkeit"
    ),
    "Length in metres of one unit of the scene's coordinates; 0: that of the scene's scale.json, unknown without the "
    "file": (
        "Länge einer Einheit der Szenenkoordinaten in Metern; 0: die aus der scale.json der Szene, ohne die Datei "
        "unbekannt"
    ),
    "Degree of the spherical harmonics, which let color change with the viewing direction": (
        "Grad der Kugelflächenfunktionen, durch die sich Farbe mit der Blickrichtung ändern kann"
    ),
    "Seed of everything random: the same seed on the same machine gives the same result": (
        "Startwert für alles Zufällige: Derselbe Startwert gibt auf demselben Rechner dasselbe Ergebnis"
    ),
    "What computes": "Was rechnet",
    "The fastest that runs on this machine": "Das Schnellste, was auf diesem Rechner läuft",
    "Native code on the processor": "Maschinencode auf dem Prozessor",
    "Native code on an NVIDIA graphics card": "Maschinencode auf einer NVIDIA-Grafikkarte",
    "Native code on a graphics card of any make, through Vulkan, Metal or DirectX 12": (
        "Maschinencode auf einer Grafikkarte jedes Herstellers, über Vulkan, Metal oder DirectX 12"
    ),
    "PyTorch without native code: slow, the reference for the others": (
        "PyTorch ohne Maschinencode: langsam, der Maßstab für die anderen"
    ),
    "A Python that has the engine's packages; empty: the environment of Install Engine": (
        "Ein Python mit den Paketen des Rechenkerns; leer: die Umgebung von „Rechenkern einrichten“"
    ),
    "Job": "Auftrag",
    "Name of the job; empty: the one that ended last": "Name des Auftrags; leer: der zuletzt beendete",
    "Name of the job; empty: the one that was started last": "Name des Auftrags; leer: der zuletzt begonnene",
    "The result is kept.": "Das Ergebnis bleibt erhalten.",
    "Stop Now": "Sofort abbrechen",
    "A job is running: wait for its end, or cancel it": "Ein Auftrag läuft: sein Ende abwarten oder ihn abbrechen",
    "Add Water to Objects": "Objekten Wasser hinzufügen",
    (
        "Address of an additional package index, for another build of torch than the usual one: PyTorch's own"
        " has builds without CUDA and for each version of CUDA (pytorch.org, Get Started)"
    ): (
        "Adresse eines zusätzlichen Paketverzeichnisses, für eine andere Fassung von torch als die übliche: "
        "Das von PyTorch hat Fassungen ohne CUDA und für jede Version von CUDA (pytorch.org, Get Started)"
    ),
    "All splat objects that are visible in the viewport": "Alle Splat-Objekte, die in der Ansicht sichtbar sind",
    "Analyse the photos and list which effects training should model, with evidence and cost": (
        "Die Fotos auswerten und auflisten, welche Effekte das Training modellieren soll, mit Beleg und Kosten"
    ),
    "As the plan decided; undetermined effects stay off": (
        "Wie der Plan entschieden hat; unbestimmte Effekte bleiben aus"
    ),
    "As Trained": "Wie trainiert",
    (
        "Blend sRGB values under the view transform Raw, as training does, to compare renders with photos; "
        "other objects get wrong colors. Off: blend linear light, right beside other objects"
    ): (
        "sRGB-Werte unter der Ansichtstransformation Raw mischen, wie das Training, um Bilder mit Fotos zu "
        "vergleichen; andere Objekte bekommen falsche Farben. Aus: lineares Licht mischen, richtig neben "
        "anderen Objekten"
    ),
    "COLMAP Scene": "COLMAP-Szene",
    "Check Photos": "Fotos prüfen",
    "Continue the run in the run folder where it stopped": (
        "Den Lauf im Ordner des Laufs fortsetzen, wo er stehen blieb"
    ),
    "Count the photos, cameras and points of the folder, and list the problems found": (
        "Fotos, Kameras und Punkte des Ordners zählen und gefundene Probleme auflisten"
    ),
    "Counts and warnings of the folder of photos": "Anzahlen und Warnungen zum Ordner der Fotos",
    "Decision of the plan: on, off or undetermined": "Entscheidung des Plans: ein, aus oder unbestimmt",
    "Distance between the two after scaling": "Abstand zwischen den beiden nach dem Skalieren",
    "Do not model it, whatever the plan decided": "Nicht modellieren, wie auch der Plan entschieden hat",
    "Download Networks": "Netze herunterladen",
    "Download networks that are not on this machine from their authors": (
        "Netze, die auf diesem Rechner fehlen, von ihren Urhebern herunterladen"
    ),
    "Duration of the last run": "Dauer des letzten Laufs",
    "Extra Properties": "Weitere Eigenschaften",
    "Find splats by words: writes swag:similarity and selects the splats above the threshold": (
        "Splats nach Worten finden: schreibt swag:similarity und wählt die Splats über der Schwelle"
    ),
    "Folder that the training writes to; empty: the folder swag_run beside the photos": (
        "Ordner, in den das Training schreibt; leer: der Ordner swag_run neben den Fotos"
    ),
    "Folder with the photos and their cameras": "Ordner mit den Fotos und ihren Kameras",
    "Follow the plan again in every effect": "In jedem Effekt wieder dem Plan folgen",
    "Forecast of each quality and the settings it was made for, as JSON": (
        "Vorhersage für jede Güte und die Einstellungen, für die sie gilt, als JSON"
    ),
    (
        "How much water the colors show, from 0 (removed) to 1 (as photographed); with water they are right only from "
        "where the photos were taken, and open water behind the splats is missing"
    ): (
        "Wie viel Wasser die Farben zeigen, von 0 (entfernt) bis 1 (wie fotografiert); mit Wasser stimmen sie nur von "
        "dort aus, wo die Fotos gemacht wurden, und offenes Wasser hinter den Splats fehlt"
    ),
    "Fraction of the fitted water that is shown: 0 none, 1 as photographed; it can be animated": (
        "Anteil des angepassten Wassers, der gezeigt wird: 0 keins, 1 wie fotografiert; er lässt sich animieren"
    ),
    "Haze": "Trübung",
    "Fraction of the splats in open water that is shown: 0 none, 1 as trained. At least as much is shown as of the "
    "water": (
        "Anteil der Splats im freien Wasser, der gezeigt wird: 0 keine, 1 wie trainiert. Es wird mindestens so viel "
        "gezeigt wie vom Wasser"
    ),
    "By how sure it is that the splat is open water; the slider Haze shows such splats": (
        "Danach, wie sicher der Splat freies Wasser ist; der Regler Trübung zeigt solche Splats"
    ),
    "From Selection": "Aus Auswahl",
    "Give every splat of the run a label: from your masks, from words or from salient regions": (
        "Jedem Splat des Laufs ein Etikett geben: aus eigenen Masken, aus Worten oder aus auffälligen Bereichen"
    ),
    "Highest degree of spherical harmonics; 0 makes colors the same from every view, and the smallest file": (
        "Höchster Grad der Kugelflächenfunktionen; mit 0 sind Farben aus jedem Blick gleich und die Datei am kleinsten"
    ),
    (
        "Highest degree of spherical harmonics; a lower one takes less memory, and 0 makes colors the same "
        "from every view"
    ): (
        "Höchster Grad der Kugelflächenfunktionen; ein kleinerer braucht weniger Speicher, und mit 0 sind "
        "Farben aus jedem Blick gleich"
    ),
    "Import a scene or open splats; where there are several, select one of them": (
        "Eine Szene importieren oder Splats öffnen; wo es mehrere gibt, eins davon auswählen"
    ),
    "Import the cameras, the photos and the points of a COLMAP reconstruction": (
        "Kameras, Fotos und Punkte einer COLMAP-Rekonstruktion importieren"
    ),
    "In the COLMAP coordinates of the imported scene that the file belongs to": (
        "In den COLMAP-Koordinaten der importierten Szene, zu der die Datei gehört"
    ),
    (
        "Install from the wheels in this folder, without internet. On a computer with internet, pip download "
        "-r requirements.txt -c constraints.txt fills it"
    ): (
        "Aus den Wheels in diesem Ordner einrichten, ohne Internet. Auf einem Rechner mit Internet füllt ihn "
        "pip download -r requirements.txt -c constraints.txt"
    ),
    "List what the engine's Python has: packages with versions, processor, graphics card": (
        "Auflisten, was das Python des Rechenkerns hat: Pakete mit Versionen, Prozessor, Grafikkarte"
    ),
    ("Look up which build of torch would be installed and how much would be downloaded, without downloading it"): (
        "Nachsehen, welche Fassung von torch eingerichtet und wie viel heruntergeladen würde, ohne es herunterzuladen"
    ),
    "Minimum Opacity": "Mindestdeckkraft",
    "Model it, whatever the plan decided": "Modellieren, wie auch der Plan entschieden hat",
    "Move the selected splats to a new object": "Die gewählten Splats in ein neues Objekt verschieben",
    "Move the splats of the other selected objects into the active one": (
        "Die Splats der anderen gewählten Objekte in das aktive verschieben"
    ),
    "Name of the mask; empty: the words of the search": "Name der Maske; leer: die Worte der Suche",
    "Networks that find what you name in the photos": "Netze, die in den Fotos finden, was man nennt",
    "No environment is installed": "Es ist keine Umgebung eingerichtet",
    "Only splats inside the bounding box of this object; an empty has its cube": (
        "Nur Splats im Hüllquader dieses Objekts; bei einem Leerobjekt in seinem Würfel"
    ),
    "Open water, salient regions and the rest; needs no networks": (
        "Offenes Wasser, auffällige Bereiche und der Rest; braucht keine Netze"
    ),
    "PLY in the COLMAP coordinates of the imported scene": "PLY in den COLMAP-Koordinaten der importierten Szene",
    "PLY with Blender's own axes; a GLB or SPZ always has y up": (
        "PLY mit Blenders eigenen Achsen; ein GLB oder SPZ hat y immer oben"
    ),
    "PLY with y up, for programs that do not turn a PLY; a GLB or SPZ always has y up": (
        "PLY mit y oben, für Programme, die ein PLY nicht drehen; ein GLB oder SPZ hat y immer oben"
    ),
    "PSNR on held-out photos, in dB": "PSNR an zurückgehaltenen Fotos, in dB",
    "Pause or Resume": "Anhalten oder fortsetzen",
    "Pause the training, or resume it; the result is the same as without a pause": (
        "Das Training anhalten oder fortsetzen; das Ergebnis ist dasselbe wie ohne Pause"
    ),
    "Photos": "Fotos",
    "COLMAP Model with Photos": "COLMAP-Modell mit Fotos",
    "Other Cameras": "Andere Kameras",
    "Placement": "Platzierung",
    "Plan determines from the photos which effects training should model.": (
        "Planen bestimmt aus den Fotos, welche Effekte das Training modellieren soll."
    ),
    "Remove Water from Objects": "Wasser von Objekten entfernen",
    "Remove the asset library and its files": "Die Asset-Bibliothek und ihre Dateien entfernen",
    "Remove the water's nodes from the materials": "Die Knoten des Wassers aus den Materialien entfernen",
    "Render engine to set up": "Renderer, der vorbereitet wird",
    "Resume": "Weiter",
    "Run folder that the names are from": "Ordner des Laufs, aus dem die Namen sind",
    "Run folder; empty: the folder of the run of the splats": "Ordner des Laufs; leer: der Ordner des Laufs der Splats",
    "SSIM on held-out photos": "SSIM an zurückgehaltenen Fotos",
    "Salient Regions": "Auffällige Bereiche",
    "Save as Mask": "Als Maske speichern",
    "All": "Alle",
    "All splats of the objects, hidden ones too": "Alle Splats der Objekte, auch verborgene",
    "Splats": "Splats",
    "Splats that are not hidden and lie inside the crop box of their object": (
        "Splats, die nicht verborgen sind und im Ausschnitt ihres Objekts liegen"
    ),
    "The selected splats": "Die gewählten Splats",
    "Write labels and other properties of the splats, too": (
        "Auch Etiketten und andere Eigenschaften der Splats schreiben"
    ),
    (
        "Write the cameras, too: into a GLB, and to the folder NAME_cameras beside the file as a COLMAP text model, "
        "transforms.json and, where the run models water, water.json"
    ): (
        "Auch die Kameras schreiben: in ein GLB, und in den Ordner NAME_cameras neben der Datei als COLMAP-"
        "Textmodell, transforms.json und, wo der Lauf Wasser modelliert, water.json"
    ),
    "Save the selection as an attribute mask:NAME, for geometry nodes": (
        "Die Auswahl als Attribut mask:NAME speichern, für Geometrieknoten"
    ),
    "Select the splats of this label; with Shift in addition to the selection": (
        "Die Splats dieses Etiketts wählen; mit Umschalt zusätzlich zur Auswahl"
    ),
    "Set up Cycles or EEVEE for splats: transparency, colors, the background of the run, image size": (
        "Cycles oder EEVEE für Splats vorbereiten: Transparenz, Farben, der Hintergrund des Laufs, Bildgröße"
    ),
    "World": "Welt",
    "What is behind the splats. Default: a world of your own is kept": (
        "Was hinter den Splats ist. Standard: eine eigene Welt bleibt"
    ),
    "Background of the Run": "Hintergrund des Laufs",
    "Open water or the background color of the run, as in films; your own world stays in the file": (
        "Offenes Wasser oder die Hintergrundfarbe des Laufs, wie in Filmen; die eigene Welt bleibt in der Datei"
    ),
    "Keep": "Behalten",
    "Leave the world of the scene as it is": "Die Welt der Szene lassen, wie sie ist",
    "Background": "Hintergrund",
    (
        "Viewports show what is behind the splats in films: open water, or the background color of the run. Off: the "
        "viewport's own background"
    ): (
        "Viewports zeigen, was in Filmen hinter den Splats ist: offenes Wasser oder die Hintergrundfarbe des Laufs. "
        "Aus: der Hintergrund des Viewports selbst"
    ),
    "Show the selected objects through the water of the splats, by nodes in their materials": (
        "Die gewählten Objekte durch das Wasser der Splats zeigen, durch Knoten in ihren Materialien"
    ),
    "Show this label alone; click again to show all labels": (
        "Dieses Etikett allein zeigen; ein weiterer Klick zeigt alle Etiketten"
    ),
    "Sorts every splat by depth, among other objects and other splat objects too": (
        "Ordnet jeden Splat nach seiner Tiefe ein, auch zwischen anderen Objekten und anderen Splat-Objekten"
    ),
    "Source": "Quelle",
    "Splats with a higher similarity than this to the search are selected": (
        "Splats, die dem Gesuchten ähnlicher sind als dies, werden gewählt"
    ),
    "No job is running": "Es läuft kein Auftrag",
    "Stop the running job; a training keeps its result so far": (
        "Den laufenden Auftrag abbrechen; ein Training behält sein bisheriges Ergebnis"
    ),
    "The masks in the scene's folder labels, or salient regions where it has none": (
        "Die Masken im Ordner labels der Szene, oder auffällige Bereiche, wo sie keine hat"
    ),
    "This plan was made for other photos: plan again.": "Dieser Plan gilt für andere Fotos: neu planen.",
    "Train 3D Gaussians on the photos; Cancel stops and keeps the result so far": (
        "3D-Gaußglocken mit den Fotos trainieren; Abbrechen hält an und behält das bisherige Ergebnis"
    ),
    "Sizes that each quality gives the photos and what they depend on, as JSON": (
        "Größen, die jede Güte den Fotos gibt, und wovon sie abhängen, als JSON"
    ),
    "Little memory is free: these numbers are lowered. Close other programs and press Check.": (
        "Wenig Speicher ist frei: Diese Zahlen sind verringert. Andere Programme schließen und Prüfen drücken."
    ),
    "This machine is measured when training starts: the numbers follow from it.": (
        "Dieser Rechner wird gemessen, wenn das Training beginnt: Daraus folgen die Zahlen."
    ),
    "Typical numbers: the photos set them when training starts. Check shows them.": (
        "Typische Zahlen: Die Fotos bestimmen sie, wenn das Training beginnt. Prüfen zeigt sie."
    ),
    "Train for some seconds and forecast the time, PSNR and memory of each quality on this machine": (
        "Einige Sekunden trainieren und Zeit, PSNR und Speicher jeder Güte auf diesem Rechner vorhersagen"
    ),
    "Uses the graphics card; draws one splat object completely in front of another": (
        "Nutzt die Grafikkarte; zeichnet ein Splat-Objekt ganz vor einem anderen"
    ),
    "Value of swag:label": "Wert von swag:label",
    "What assigns the labels": "Woraus die Etiketten bestimmt werden",
    "What to look for; empty: the words in the panel": "Was zu suchen ist; leer: die Worte im Feld",
    "Whether the last run was stopped before its end": "Ob der letzte Lauf vor seinem Ende abgebrochen wurde",
    "Whether training models this effect": "Ob das Training diesen Effekt modelliert",
    "Write the node groups of splats and water to an asset library, for the asset browser in every file": (
        "Die Knotengruppen von Splats und Wasser in eine Asset-Bibliothek schreiben, für den Asset-Browser in"
        " jeder Datei"
    ),
    "Your own mask images: one folder for each label, with an image for each photo": (
        "Eigene Maskenbilder: ein Ordner für jedes Etikett, mit einem Bild für jedes Foto"
    ),
    "A lamp is at the camera": "Lampe an der Kamera",
    "Advanced": "Erweitert",
    "Allow Online Access": "Online-Zugriff erlauben",
    "Allow online access in Preferences > System > Network, or set a folder of wheels": (
        "Online-Zugriff in Einstellungen > System > Netzwerk erlauben, oder einen Ordner mit Wheels setzen"
    ),
    "Above": "Darüber",
    "Action": "Aktion",
    "A colored point for each splat, which any graphics card draws fast": (
        "Ein farbiger Punkt für jeden Splat, den jede Grafikkarte schnell zeichnet"
    ),
    "Density": "Dichte",
    "Display As": "Anzeigen als",
    "Highest degree of spherical harmonics in viewports and renders; 0 makes colors the same from every view": (
        "Höchster Grad der Kugelflächenfunktionen in Viewports und Renderbildern; bei 0 sind die Farben von überall"
        " gleich"
    ),
    "Percentage of the splats that viewports show; renders show all": (
        "Anteil der Splats, den Viewports zeigen, in Prozent; Renderbilder zeigen alle"
    ),
    "Points": "Punkte",
    "The splats as trained, with view-dependent colors": "Die Splats wie trainiert, mit blickabhängigen Farben",
    "What viewports show, except in Rendered shading": "Was Viewports zeigen, außer in der Schattierung Gerendert",
    "Add Crop Box": "Ausschnitt hinzufügen",
    "Add a box around the splats that limits what is shown, rendered and exported; move, rotate and scale it": (
        "Einen Kasten um die Splats legen, der begrenzt, was gezeigt, gerendert und exportiert wird; er lässt sich"
        " verschieben, drehen und skalieren"
    ),
    "Below": "Darunter",
    "Box": "Rechteck",
    "Circle": "Kreis",
    "By the difference from a color": "Nach dem Unterschied zu einer Farbe",
    "By the distance to the nearest camera of the photos": "Nach dem Abstand zur nächsten Kamera der Fotos",
    "By the largest standard deviation of the splat": "Nach der größten Standardabweichung des Splats",
    "By the name of the label": "Nach dem Namen des Etiketts",
    "By the opacity of the splat": "Nach der Deckkraft des Splats",
    "Click two points of the splats to see their distance in the scene's unit": (
        "Zwei Punkte der Splats anklicken, um ihren Abstand in der Einheit der Szene zu sehen"
    ),
    "Click the outer corners of the chart's four corner patches, going around it; Escape: cancel": (
        "Reihum die äußeren Ecken der vier Eckfelder der Farbtafel anklicken; Escape: abbrechen"
    ),
    "Click two points whose distance you know; Escape: cancel": (
        "Zwei Punkte anklicken, deren Abstand bekannt ist; Escape: abbrechen"
    ),
    "Click two points to measure their distance; Escape: end": (
        "Zwei Punkte anklicken, um ihren Abstand zu messen; Escape: beenden"
    ),
    "Color that splats are compared with; at first that of the selected splats": (
        "Farbe, mit der Splats verglichen werden; anfangs die der ausgewählten Splats"
    ),
    "Compute how the PSNR on the held-out photos changes when the selected splats are deleted; Escape stops": (
        "Berechnen, wie sich der PSNR auf den zurückgehaltenen Fotos ändert, wenn die ausgewählten Splats gelöscht"
        " werden; Escape bricht ab"
    ),
    "Delete": "Löschen",
    "Delete Outside Box": "Außerhalb des Ausschnitts löschen",
    "Delete Splats": "Splats löschen",
    "Delete the selected splats; labels, masks and what is hidden stay for the others": (
        "Die ausgewählten Splats löschen; Etiketten, Masken und Verborgenes bleiben bei den anderen erhalten"
    ),
    "Delete the splats outside the crop box for good; the box stays": (
        "Die Splats außerhalb des Ausschnitts endgültig löschen; der Kasten bleibt"
    ),
    "Deselect all splats": "Alle Splats abwählen",
    "Deselect these": "Diese abwählen",
    "Distance to Camera": "Abstand zur Kamera",
    "Distance to Others": "Abstand zu anderen",
    "Drag a box around splats; Shift: extend, Ctrl: subtract, Escape: cancel": (
        "Ein Rechteck um Splats ziehen; Umschalt: erweitern, Strg: abziehen, Escape: abbrechen"
    ),
    "Draw around splats; Shift: extend, Ctrl: subtract, Escape: cancel": (
        "Splats umfahren; Umschalt: erweitern, Strg: abziehen, Escape: abbrechen"
    ),
    "Edit": "Bearbeiten",
    "Fewer Photos Than": "Weniger Fotos als",
    "Find Floaters": "Floater finden",
    "Hide": "Verbergen",
    "Hide Others": "Andere verbergen",
    "Hide Splats": "Splats verbergen",
    "Hide the selected splats in the viewport and in renders": (
        "Die ausgewählten Splats im Viewport und beim Rendern verbergen"
    ),
    "Hide the splats that are not selected instead": "Stattdessen die Splats verbergen, die nicht ausgewählt sind",
    "Import or train splats first": "Zuerst Splats importieren oder trainieren",
    "In Front": "Davor",
    "Invert": "Umkehren",
    "Kind": "Art",
    "Measure": "Messen",
    "Mode": "Modus",
    "Name of the label, or a part of it": "Name des Etiketts oder ein Teil davon",
    "None": "Keine",
    "Object whose box limits the splats that are shown, rendered and exported": (
        "Objekt, dessen Kasten begrenzt, welche Splats gezeigt, gerendert und exportiert werden"
    ),
    "Opacity": "Deckkraft",
    "Opacity, difference of color or certainty to compare with": (
        "Deckkraft, Farbunterschied oder Sicherheit, mit der verglichen wird"
    ),
    "PSNR Without Selection": "PSNR ohne Auswahl",
    "Paint over splats; wheel: size, Shift: extend, Ctrl: subtract, Escape or Enter: finish": (
        "Über Splats malen; Mausrad: Größe, Umschalt: erweitern, Strg: abziehen, Escape oder Enter: fertig"
    ),
    "Point at the splats to read them; click: place the 3D cursor and report, Escape: end": (
        "Auf Splats zeigen, um sie abzulesen; Klick: 3D-Cursor setzen und melden, Escape: beenden"
    ),
    "Radius of the brush": "Radius des Pinsels",
    "Radius of the sphere": "Radius der Kugel",
    "Brush": "Pinsel",
    "Sphere": "Kugel",
    "Flood": "Füllen",
    "Select Brush": "Mit Pinsel auswählen",
    "Select Sphere": "Kugel auswählen",
    "Select Flood": "Füllend auswählen",
    "Select Splats Box": "Splats auswählen: Rechteck",
    "Select Splats Circle": "Splats auswählen: Kreis",
    "Select Splats Lasso": "Splats auswählen: Lasso",
    "Select Splats Brush": "Splats auswählen: Pinsel",
    "Select Splats Sphere": "Splats auswählen: Kugel",
    "Select Splats Flood": "Splats auswählen: Füllen",
    "Select splats by dragging a circle from its middle in the viewport; Shift adds, Ctrl removes": (
        "Splats auswählen, indem man in der Ansicht einen Kreis von seiner Mitte aus zieht; Umschalt fügt hinzu, Strg "
        "entfernt"
    ),
    "Select splats by painting with a brush in the viewport; the mouse wheel changes its size": (
        "Splats auswählen, indem man sie in der Ansicht mit einem Pinsel übermalt; das Mausrad ändert seine Größe"
    ),
    "Select the splats in a sphere around the one that you click; a drag or the wheel changes its size": (
        "Die Splats in einer Kugel um den angeklickten auswählen; Ziehen oder das Mausrad ändert ihre Größe"
    ),
    "Select the connected splats of similar color and the same label around the one that you click": (
        "Die Splats ähnlicher Farbe und gleichen Etiketts auswählen, die mit dem angeklickten zusammenhängen"
    ),
    "Click a splat; wheel or drag: radius, Shift: extend, Ctrl: subtract, Escape: cancel": (
        "Einen Splat anklicken; Mausrad oder Ziehen: Radius, Umschalt: hinzufügen, Strg: entfernen, Escape: abbrechen"
    ),
    "Click a splat to select those of its color around it; Shift: extend, Ctrl: subtract, Escape: cancel": (
        "Einen Splat anklicken, um die seiner Farbe um ihn auszuwählen; Umschalt: hinzufügen, Strg: entfernen, Escape: "
        "abbrechen"
    ),
    "Drag from the middle of a circle; Shift: extend, Ctrl: subtract, Escape: cancel": (
        "Von der Mitte eines Kreises aus ziehen; Umschalt: hinzufügen, Strg: entfernen, Escape: abbrechen"
    ),
    "Tolerance": "Toleranz",
    "Largest difference from the color around the splat": "Größter Unterschied zur Farbe um den Splat",
    "Gap": "Lücke",
    "Longest gap between connected splats; 0: by their sizes": (
        "Größte Lücke zwischen zusammenhängenden Splats; 0: nach ihren Größen"
    ),
    "Label Name": "Etikett",
    "Same Label": "Gleiches Etikett",
    "Select only splats with the label of the splat": "Nur Splats mit dem Etikett des Splats auswählen",
    "Read Point": "Punkt ablesen",
    "Select All Splats": "Alle Splats auswählen",
    "Select Box": "Rechteck auswählen",
    "Select By": "Auswählen nach",
    "Select Circle": "Kreis auswählen",
    "Select Lasso": "Lasso auswählen",
    "Select Through": "Durch andere hindurch",
    "Select all splats": "Alle Splats auswählen",
    "Select all splats that are shown, none, or those that are not selected": (
        "Alle gezeigten Splats auswählen, keine, oder die nicht ausgewählten"
    ),
    "Select splats above the threshold": "Splats über der Schwelle auswählen",
    "Select splats behind others too; most of what is seen has splats behind it": (
        "Auch Splats hinter anderen auswählen; hinter fast allem, was man sieht, liegen Splats"
    ),
    "Select splats below the threshold": "Splats unter der Schwelle auswählen",
    "Select splats by dragging a box in the viewport; Shift adds, Ctrl removes": (
        "Splats auswählen, indem im Viewport ein Rechteck gezogen wird; Umschalt erweitert die Auswahl, Strg zieht ab"
    ),
    "Select splats by drawing around them in the viewport; Shift adds, Ctrl removes": (
        "Splats auswählen, indem man sie im Viewport umfährt; Umschalt erweitert die Auswahl, Strg zieht ab"
    ),
    "Select splats by their size, opacity, color, label or distance; the threshold can be changed afterwards": (
        "Splats nach Größe, Deckkraft, Farbe, Etikett oder Abstand auswählen; die Schwelle lässt sich danach ändern"
    ),
    "Select splats in front of the surfaces that the photos show, and splats that few photos see": (
        "Splats auswählen, die vor den Oberflächen der Fotos schweben, und solche, die wenige Fotos sehen"
    ),
    "Select splats of which at least this part, as the photos see it, is in front of the surface": (
        "Splats auswählen, von denen mindestens dieser Teil, wie ihn die Fotos sehen, vor der Oberfläche liegt"
    ),
    "Select splats that fewer photos than this see; 0 for none": (
        "Splats auswählen, die weniger Fotos als so viele sehen; 0: keine"
    ),
    "Select these alone": "Nur diese auswählen",
    "Select these too": "Diese zusätzlich auswählen",
    "Select those that are not selected, and deselect the others": (
        "Die nicht ausgewählten auswählen und die anderen abwählen"
    ),
    "Set": "Setzen",
    "Show Hidden Splats": "Verborgene Splats zeigen",
    "Show position, range, label and opacity of the splat under the pointer": (
        "Ort, Entfernung, Etikett und Deckkraft des Splats unter dem Mauszeiger zeigen"
    ),
    "Show the hidden splats again and select them; hidden labels stay hidden": (
        "Die verborgenen Splats wieder zeigen und auswählen; verborgene Etiketten bleiben verborgen"
    ),
    "Side": "Seite",
    "Size": "Größe",
    "Size or distance to compare with": "Größe oder Abstand, mit dem verglichen wird",
    "Splats with fewer than six others within a distance": (
        "Splats mit weniger als sechs anderen innerhalb eines Abstands"
    ),
    "Subtract": "Abziehen",
    "Unselected": "Nicht ausgewählte",
    "What happens to the splats that are selected already": "Was mit den schon ausgewählten Splats geschieht",
    "What splats are selected by": "Wonach Splats ausgewählt werden",
    "Which splats are selected": "Welche Splats ausgewählt werden",
    "Which splats are selected afterwards": "Welche Splats danach ausgewählt sind",
    "{count} splats of {name} were moved, but their sizes and rotations could not follow: undo this to keep them "
    "right. To join objects, use Merge in the panel Edit.": (
        "{count} Splats von {name} wurden bewegt, aber ihre Größen und Drehungen konnten nicht folgen: mit Rückgängig "
        "bleiben sie richtig. Zum Zusammenfügen von Objekten dient Vereinen im Panel Bearbeiten."
    ),
    "{selected} of {total} splats selected": "{selected} von {total} Splats ausgewählt",
    "A PNG file for each frame, without loss; a stopped film can be continued": (
        "Eine PNG-Datei je Bild, ohne Verlust; ein angehaltener Film kann fortgesetzt werden"
    ),
    "Add Turntable": "Drehteller hinzufügen",
    "Add a camera that goes around the selected objects or splats, around all splats where none are selected": (
        "Eine Kamera hinzufügen, die um die gewählten Objekte oder Splats fährt, ohne Auswahl um alle Splats"
    ),
    "Add a camera that passes through the selected cameras in the order of their names": (
        "Eine Kamera hinzufügen, die in der Reihenfolge der Namen durch die gewählten Kameras fährt"
    ),
    "Alpha": "Alpha",
    "Camera Path Through Photos": "Kamerafahrt durch Fotos",
    "Compare with Photos": "Mit Fotos vergleichen",
    "Depth": "Tiefe",
    "Elevation": "Höhenwinkel",
    "Files that the film is written to": "Dateien, in die der Film geschrieben wird",
    "Film": "Film",
    "Folder of the film; empty: the folder film in the folder of the run": (
        "Ordner des Films; leer: der Ordner film im Ordner des Laufs"
    ),
    "Format": "Format",
    "Frames": "Bilder",
    "Height of the camera as an angle above the horizon": "Höhe der Kamera als Winkel über dem Horizont",
    "How far the camera goes; below a full circle it stays on the side of the photos": (
        "Wie weit die Kamera fährt; unter einem vollen Kreis bleibt sie auf der Seite der Fotos"
    ),
    "Image Sequence": "Bildfolge",
    "Import the scene with the photos first": "Zuerst die Szene mit den Fotos importieren",
    "Length of the film in frames": "Länge des Films in Bildern",
    "Overwrite": "Überschreiben",
    "Photos are compared in a 3D viewport": "Fotos werden in einer 3D-Ansicht verglichen",
    "Render Film": "Film rendern",
    "Render the splats for each frame of the scene with the engine, as they were trained, to images or a video": (
        "Die Splats für jedes Bild der Szene mit dem Rechenkern rendern, so wie trainiert, als Bilder oder Video"
    ),
    "Samples": "Abtastungen",
    "Samples of a pixel: more of them smooth edges and shadows of other objects, and take longer": (
        "Abtastungen eines Pixels: mehr davon glätten Kanten und Schatten anderer Objekte und dauern länger"
    ),
    "Select two or more cameras in object mode first": "Zuerst im Objektmodus zwei oder mehr Kameras wählen",
    "Step through the photos in the camera view, with the photo left of a line that you drag and the splats right": (
        "Die Fotos in der Kameraansicht durchgehen: links einer verschiebbaren Linie das Foto, rechts die Splats"
    ),
    "Sweep": "Schwenk",
    "The scene has no camera: add a turntable or a camera path": (
        "Die Szene hat keine Kamera: einen Drehteller oder eine Kamerafahrt hinzufügen"
    ),
    "There are no splats and no selected objects in object mode": (
        "Im Objektmodus gibt es keine Splats und keine gewählten Objekte"
    ),
    "There are no splats that are shown in the viewport and in renders": (
        "Es gibt keine Splats, die in der Ansicht und beim Rendern gezeigt werden"
    ),
    "Video": "Video",
    "Write the distance along the camera's axis in Blender units to an OpenEXR file for each frame": (
        "Den Abstand entlang der Kameraachse in Blender-Einheiten je Bild in eine OpenEXR-Datei schreiben"
    ),
    "film.mp4 (MPEG-4), to look at; it is written when all frames are done": (
        "film.mp4 (MPEG-4) zum Ansehen; geschrieben, wenn alle Bilder fertig sind"
    ),
    "As good as possible in a time; the size is chosen by measuring this machine": (
        "So gut wie in einer Zeit möglich; die Größe wird durch Messen auf diesem Rechner gewählt"
    ),
    "Attenuation": "Dämpfung",
    "Backscatter": "Rückstreuung",
    "Beam": "Lichtkegel",
    "Blender has no online access.": "Blender hat keinen Online-Zugriff.",
    "Caustics": "Kaustiken",
    "Filled cells": "Volle Felder",
    "Choose photos or a video first": "Zuerst Fotos oder ein Video wählen",
    "Choose photos or a video first.": "Zuerst Fotos oder ein Video wählen.",
    "Clear coast": "Klare Küste",
    "Clear open ocean": "Klarer offener Ozean",
    "Clearest open ocean": "Klarster offener Ozean",
    "Coast": "Küste",
    "Compare With": "Vergleichen mit",
    "Corners are darker": "Die Ecken sind dunkler",
    "Depth prior": "Tiefenvorwissen",
    "Variation": "Schwankung",
    "Draft": "Entwurf",
    "Each photo has an exposure and a color balance of its own.": (
        "Jedes Foto hat eine eigene Belichtung und einen eigenen Weißabgleich."
    ),
    "BIC gain": "BIC-Gewinn",
    "Exposure": "Belichtung",
    "Development": "Entwicklung",
    "Exposure and white point of restored colors; they fade as the slider Water adds water": (
        "Belichtung und Weißpunkt wiederhergestellter Farben; sie verschwinden, wie der Regler Wasser Wasser hinzufügt"
    ),
    "Automatic": "Automatisch",
    "Exposure and white point that training found in near, bright, neutral parts": (
        "Belichtung und Weißpunkt, die das Training in nahen, hellen, neutralen Stellen fand"
    ),
    "Color Chart": "Farbtafel",
    "From a color chart in the photos": "Nach einer Farbtafel auf den Fotos",
    "The photos have no color chart.": "Auf den Fotos ist keine Farbtafel.",
    "Colors as restored, which may be dark or clipped": (
        "Farben, wie sie wiederhergestellt wurden; sie können dunkel oder überstrahlt sein"
    ),
    "Further exposure of the splats, in stops": "Zusätzliche Belichtung der Splats in Blendenstufen",
    "Temperature": "Farbtemperatur",
    "White balance between blue (below 0) and orange (above 0)": (
        "Weißabgleich zwischen Blau (unter 0) und Orange (über 0)"
    ),
    "Tint": "Tönung",
    "White balance between green (below 0) and magenta (above 0)": (
        "Weißabgleich zwischen Grün (unter 0) und Magenta (über 0)"
    ),
    "Contrast": "Kontrast",
    "Contrast about middle grey; 1 changes nothing": "Kontrast um mittleres Grau; 1 ändert nichts",
    "Reset Colors": "Farben zurücksetzen",
    "Go back to the automatic development, without own exposure, white balance and contrast": (
        "Zurück zur automatischen Entwicklung ohne eigene Belichtung, eigenen Weißabgleich und Kontrast"
    ),
    "Develop the colors as the panel Color says; highlights are not rolled off": (
        "Farben entwickeln, wie es im Bereich Farbe steht; helle Stellen werden nicht abgeflacht"
    ),
    "Exposure varies": "Die Belichtung schwankt",
    "Color fading": "Farbverlust",
    "Fall-off": "Abfall",
    "Range ratio": "Abstände",
    "Figures": "Zahlen",
    "Finished": "Fertig",
    "Fish or divers move": "Fische oder Taucher",
    "Fish, divers and other moving objects are masked out.": (
        "Fische, Taucher und anderes Bewegtes werden ausgeblendet."
    ),
    "Fitted to the photos": "An die Fotos angepasst",
    "Flicker": "Flackern",
    "Shared flicker": "Gleiches Flackern",
    "Folder of the photos that the plan was made for": "Ordner der Fotos, für die der Plan gilt",
    "Folder of the run, which has config.json and result.ply": (
        "Ordner des Laufs, in dem config.json und result.ply sind"
    ),
    "Folder of the run; empty: the run of the active object": "Ordner des Laufs; leer: der Lauf des aktiven Objekts",
    "Frames are interpolated between photos that are far apart.": (
        "Zwischen Fotos, die weit auseinander liegen, werden Bilder interpoliert."
    ),
    "From Photos": "Aus den Fotos",
    "Haze grows at its own rate": "Der Dunst hat eigene Stärke",
    "High": "Hoch",
    "Initial attenuation of red, green and blue per metre": "Anfangswert der Dämpfung von Rot, Grün und Blau je Meter",
    "Initial attenuation of the water: fitted to the photos, or that of a Jerlov type": (
        "Anfangswert der Dämpfung des Wassers: an die Fotos angepasst, oder der eines Jerlov-Typs"
    ),
    "Installs from your folder of wheels, without internet; about 3 minutes.": (
        "Richtet aus dem Ordner mit Wheels ein, ohne Internet; etwa 3 Minuten."
    ),
    "Interpolation": "Zwischenbilder",
    "Lamp": "Lampe",
    "Largest number of Gaussians that densification may reach": (
        "Größte Zahl an Gaußglocken, bis zu der verdichtet wird"
    ),
    "Added light": "Fremdes Licht",
    "Light from a lamp at the camera falls off with its distance.": (
        "Das Licht einer Lampe an der Kamera fällt mit dem Abstand ab."
    ),
    "Light lost": "Lichtverlust",
    "Light that waves throw on the ground flickers.": "Licht, das Wellen auf den Grund werfen, flackert.",
    "Measured": "Wert",
    "Minutes": "Minuten",
    "Move the compared run beside the selected one in the viewport, and back": (
        "Den verglichenen Lauf in der Ansicht neben den gewählten rücken, und zurück"
    ),
    "Moving objects": "Bewegtes",
    "Murkiest coast": "Trübste Küste",
    "Murky coast": "Trübe Küste",
    "Murky open ocean": "Trüber offener Ozean",
    "Name of the effect in the plan": "Name des Effekts im Plan",
    "Name of the splat object of the run": "Name des Splat-Objekts des Laufs",
    "Near to far": "Nah zu fern",
    "Needed": "Nötig",
    "No splats in the scene have a fitted water": "Keine Splats in der Szene haben ein angepasstes Wasser",
    "No water is modelled: the colors are as photographed.": (
        "Kein Wasser wird modelliert: die Farben sind wie fotografiert."
    ),
    "Number of optimisation steps, each on one image": "Zahl der Optimierungsschritte, jeder mit einem Bild",
    "Observations": "Beobachtungen",
    "Open Camera Report": "Kamerabericht öffnen",
    "Open Report": "Bericht öffnen",
    "Open Run": "Lauf öffnen",
    "Open a training run: its splats, water, labels and figures, and the cameras of its photos": (
        "Einen Trainingslauf öffnen: seine Splats, Wasser, Etiketten und Zahlen, und die Kameras seiner Fotos"
    ),
    "Open ocean": "Offener Ozean",
    "Open the report of the cameras in the web browser: their path, the points that photos share, doubtful places": (
        "Den Bericht der Kameras im Browser öffnen: ihr Weg, die Punkte, die Fotos teilen, zweifelhafte Stellen"
    ),
    "Open the report of the run in the web browser: images beside photos, curves, settings": (
        "Den Bericht des Laufs im Browser öffnen: Bilder neben Fotos, Kurven, Einstellungen"
    ),
    "Open water": "Offenes Wasser",
    "Open water needs a label": "Wasser braucht Etikett",
    "Output Folder": "Ausgabeordner",
    "Own Values": "Eigene Werte",
    "Near pairs": "Nahe Paare",
    "Photos are far apart": "Fotos weit auseinander",
    "Fitting photos": "Passende Fotos",
    "Points a photo": "Punkte je Foto",
    "Shared points": "Gleiche Punkte",
    "Predicted depth helps where sparse points are few.": "Geschätzte Tiefe hilft, wo es wenige Punkte gibt.",
    "Radial part": "Radialer Teil",
    "Radius correlation": "Radiuskorrelation",
    "Reason": "Grund",
    "Rise of dark light": "Anstieg im Dunkeln",
    "Run": "Lauf",
    "Run whose figures stand beside those of the selected run": "Lauf, dessen Zahlen neben denen des gewählten stehen",
    "SWAG Run (folder)": "SWAG-Lauf (Ordner)",
    "Select Run": "Lauf wählen",
    "Select objects with materials first": "Zuerst Objekte mit Materialien auswählen",
    "Select this run and show its figures": "Diesen Lauf wählen und seine Zahlen zeigen",
    "Semantics": "Semantik",
    "Separate backscatter": "Eigene Rückstreuung",
    "Show Effect": "Effekt zeigen",
    "Show what was measured of this effect, and what it needs": (
        "Zeigen, was zu diesem Effekt gemessen wurde und was er braucht"
    ),
    "Side by Side": "Nebeneinander",
    "Visible loss": "Sichtbarer Verlust",
    "Sparse points are few": "Es gibt wenige Punkte",
    "Standard": "Standard",
    "State": "Zustand",
    "Stopped": "Angehalten",
    "Test PSNR": "PSNR (Test)",
    "Test SSIM": "SSIM (Test)",
    "The decision in a sentence, with figures and thresholds": (
        "Die Entscheidung in einem Satz, mit Zahlen und Schwellen"
    ),
    "The engine is installed: you can train.": "Der Rechenkern ist eingerichtet: Training ist möglich.",
    "The lamp has a beam": "Die Lampe hat einen Lichtkegel",
    "The lamp lights one part of each photo more than another.": (
        "Die Lampe beleuchtet einen Teil jedes Fotos stärker als einen anderen."
    ),
    "The lens darkens photos towards their corners.": "Das Objektiv dunkelt die Fotos zu den Ecken hin ab.",
    "The light that the water adds grows with range by a coefficient of its own.": (
        "Das Licht, das das Wasser hinzufügt, wächst mit dem Abstand nach einem eigenen Koeffizienten."
    ),
    "The photos cannot show whether it is so.": "Die Fotos können nicht zeigen, ob es so ist.",
    "The plan does not model it.": "Der Plan modelliert es nicht.",
    "The plan models it.": "Der Plan modelliert es.",
    "The chosen photos have no camera report: Find Cameras writes it": (
        "Die gewählten Fotos haben keinen Kamerabericht: Kameras finden schreibt ihn"
    ),
    "The run has no report yet: it is written at the end of the training": (
        "Der Lauf hat noch keinen Bericht: er wird am Ende des Trainings geschrieben"
    ),
    "The run folder is gone; only the splats are left.": "Der Ordner des Laufs ist weg; nur die Splats sind noch da.",
    "The splats get labels during training, where you switch it on.": (
        "Die Splats bekommen beim Training Etiketten, wo es eingeschaltet ist."
    ),
    "The water adds light of its own, more with distance.": "Das Wasser fügt eigenes Licht hinzu, in der Ferne mehr.",
    "The water takes light, of one color more than of another.": (
        "Das Wasser nimmt Licht, von einer Farbe mehr als von einer anderen."
    ),
    "There is no run in the scene: train, or open a run": (
        "In der Szene ist kein Lauf: trainieren, oder einen Lauf öffnen"
    ),
    "This method has its own effects: the plan is not followed.": (
        "Dieses Verfahren hat eigene Effekte: Dem Plan wird nicht gefolgt."
    ),
    "This water is per metre: set the scale in the panel Scale, or Metres per Unit.": (
        "Dieses Wasser gilt je Meter: unter Maßstab den Maßstab setzen, oder „Meter je Einheit“."
    ),
    "Time": "Zeit",
    "Time that the whole run may take": "Zeit, die der ganze Lauf brauchen darf",
    "Train first, or open a run or a splat file.": "Zuerst trainieren, oder einen Lauf oder eine Splat-Datei öffnen.",
    "Training Run": "Trainingslauf",
    "Training needs the engine, a Python of its own. Opening, showing and exporting splats works without it.": (
        "Das Training braucht den Rechenkern, ein eigenes Python. Öffnen, Zeigen und Exportieren von Splats "
        "geht ohne ihn."
    ),
    "Uncertainty": "Unsicherheit",
    "Value that the effect needs": "Wert, den der Effekt braucht",
    "Value that was measured in the photos": "Wert, der in den Fotos gemessen wurde",
    "Very clear open ocean": "Sehr klarer offener Ozean",
    "Very murky coast": "Sehr trübe Küste",
    "Vignetting": "Vignettierung",
    "Water absorbs colors": "Wasser schluckt Farben",
    "Water adds haze": "Wasser fügt Dunst hinzu",
    "Waves cast moving light": "Licht der Wellen flackert",
    "What was measured, and what is needed": "Was gemessen wurde, und was nötig ist",
    "Whether the measured value is what the effect needs": "Ob der gemessene Wert ist, was der Effekt braucht",
    "Whether there is water cannot be seen: it stays in the colors.": (
        "Ob da Wasser ist, ist nicht zu sehen: es bleibt in den Farben."
    ),
    "Width in pixels of the training images; smaller images keep their size": (
        "Breite der Trainingsbilder in Pixeln; kleinere Bilder behalten ihre Größe"
    ),
    "Your own attenuation of red, green and blue": "Eigene Dämpfung von Rot, Grün und Blau",
    "Stop Early": "Vorzeitig enden",
    "Find Color Chart": "Farbtafel finden",
    "Mark Color Chart": "Farbtafel markieren",
    "Look through the camera of a photo and click the outer corners of the four corner patches, around the chart": (
        "Durch die Kamera eines Fotos sehen und die äußeren Ecken der vier Eckfelder anklicken, um die Tafel herum"
    ),
    "Select an object with splats of a run first": "Zuerst ein Objekt mit Splats eines Laufs auswählen",
    "Select the camera of a photo that shows the chart, or look through it": (
        "Die Kamera eines Fotos auswählen, das die Farbtafel zeigt, oder durch sie sehen"
    ),
    "Look for a 24-patch color chart in the photos of the run, and compare its patches with their known colors": (
        "In den Fotos des Laufs eine Farbtafel mit 24 Feldern suchen und die Felder mit bekannten Farben vergleichen"
    ),
    "Delta E of the patches:": "Delta E der Felder:",
    "Restore Photos": "Fotos wiederherstellen",
    "Restored Photos": "Wiederhergestellte Fotos",
    "Write the photos of the run without water to its folder restored_photos, in the colors of the panel Color": (
        "Die Fotos des Laufs ohne Wasser in seinen Ordner restored_photos schreiben, in den Farben der Leiste Farbe"
    ),
    "Without Water": "Ohne Wasser",
    "Corrected": "Korrigiert",
    "Patch Left Out": "Feld ausgelassen",
    "From Chart": "Aus der Tafel",
    "Found in these photos:": "Gefunden in diesen Fotos:",
    "Maps": "Karten",
    "Made Maps": "Fertige Karten",
    "Orthomosaic": "Orthomosaik",
    "Heights": "Höhen",
    "Areas by Label": "Flächen je Etikett",
    "Profile": "Profil",
    "Pick Profile": "Profil wählen",
    "Change": "Veränderung",
    "Folder of the maps; empty: the folder maps in the folder of the run": (
        "Ordner der Karten; leer: der Ordner maps im Ordner des Laufs"
    ),
    "Pixel Size (m)": "Pixelgröße (m)",
    "Edge of a pixel in metres, or in units without a scale; 0: the size of the splats": (
        "Kante eines Pixels in Metern, ohne Maßstab in Einheiten; 0: die Größe der Splats"
    ),
    "Seen From": "Gesehen von",
    "Direction that maps are seen from": "Richtung, aus der Karten gesehen werden",
    "From Above": "Von oben",
    "Straight from above": "Senkrecht von oben",
    "Fitted Plane": "Angepasste Ebene",
    "Perpendicular to the plane that fits the splats, as for a wall": (
        "Senkrecht zu der Ebene, die zu den Splats passt, etwa für eine Wand"
    ),
    "3D Viewport": "3D-Ansicht",
    "As the 3D viewport looks now": "So, wie die 3D-Ansicht jetzt blickt",
    "For TagLab": "Für TagLab",
    "Write an orthomosaic without alpha, and a file with the pixel size": (
        "Ein Orthomosaik ohne Alpha schreiben, und eine Datei mit der Pixelgröße"
    ),
    "Further Maps": "Weitere Karten",
    "Maps that are made from the heights": "Karten, die aus den Höhen entstehen",
    "Hillshade": "Schummerung",
    "Heights shaded by light from the upper left": "Höhen, von links oben beleuchtet",
    "Slope": "Neigung",
    "Steepness in degrees": "Steilheit in Grad",
    "Rugosity": "Rauheit",
    "Surface over planar area in windows of a metre": "Oberfläche durch Grundfläche in Fenstern von einem Meter",
    "Corrected Labels": "Korrektur",
    "Corrected copy of labels.tif; its labels go to the splats, and the areas are made again": (
        "Korrigierte Kopie von labels.tif; die Splats übernehmen die Etiketten, und die Flächen werden neu gemessen"
    ),
    "Later Run": "Späterer Lauf",
    "Folder of a later run of the same place": "Ordner eines späteren Laufs vom selben Ort",
    "Find Scale": "Maßstab finden",
    "Find the scale of the later run by the alignment, where it was not measured": (
        "Den Maßstab des späteren Laufs durch das Ausrichten finden, wenn er nicht gemessen wurde"
    ),
    "Write a GeoTIFF of the run of the splats along parallel rays, with the water that the viewport shows": (
        "Ein GeoTIFF vom Lauf der Splats schreiben, mit parallelen Strahlen und dem Wasser, das die Ansicht zeigt"
    ),
    "Write a GeoTIFF of the heights of the run of the splats; places that no photo shows stay empty": (
        "Ein GeoTIFF mit den Höhen vom Lauf der Splats schreiben; was kein Foto zeigt, bleibt leer"
    ),
    "Measure the area of each label of the run: a table with errors, a label map and outlines": (
        "Die Fläche jedes Etiketts des Laufs messen: Tabelle mit Fehlern, Etikettenkarte und Umrisse"
    ),
    "Align a later run of the same place to this one, and map what changed": (
        "Einen späteren Lauf vom selben Ort auf diesen ausrichten und kartieren, was sich verändert hat"
    ),
    "Write a table and a diagram of the heights between two points, or two selected objects beside the splats": (
        "Tabelle und Diagramm der Höhen zwischen zwei Punkten schreiben, oder zwei gewählten Objekten neben den Splats"
    ),
    "Click two points of the splats to write the heights between them": (
        "Zwei Punkte der Splats anklicken, um die Höhen dazwischen zu schreiben"
    ),
    "Click both ends of the profile; Escape: end": "Beide Enden des Profils anklicken; Escape: Ende",
    "Height": "Höhe",
    "Length": "Länge",
    "Survey": "Vermessung",
    "Folder of the survey; empty: the folder swag_survey beside the photos": (
        "Ordner der Vermessung; leer: der Ordner swag_survey neben den Fotos"
    ),
    "Folder of the survey, which has survey.json": "Ordner der Vermessung, in dem survey.json liegt",
    "Choose the folder of a survey first": "Zuerst den Ordner einer Vermessung wählen",
    "Choose the folder of a survey, or in Photos the photos of a new one.": (
        "Den Ordner einer Vermessung wählen, oder unter Fotos die Fotos einer neuen."
    ),
    "Photos per Block": "Fotos pro Block",
    "A block is divided until it has at most this number of photos": (
        "Ein Block wird geteilt, bis er höchstens so viele Fotos hat"
    ),
    "Plan Survey": "Vermessung planen",
    "Divide the photos into blocks that are trained one by one, on one machine or several": (
        "Die Fotos in Blöcke teilen, die einzeln trainiert werden, auf einem Rechner oder mehreren"
    ),
    "Reading the survey.": "Die Vermessung wird gelesen.",
    "Coarse Model": "Grobmodell",
    "Waiting": "Wartet",
    "Running": "Läuft",
    "Failed": "Fehler",
    "Show Blocks": "Blöcke zeigen",
    "Show the blocks of the survey in the 3D viewport, colored by their state, which is kept up to date": (
        "Die Blöcke der Vermessung in der 3D-Ansicht zeigen, gefärbt nach ihrem Zustand, der laufend gelesen wird"
    ),
    "Train in a terminal, on as many machines as see this folder:": (
        "In einem Terminal trainieren, auf allen Rechnern, die diesen Ordner sehen:"
    ),
    "Copy": "Kopieren",
    "Copy for This Blender": "Für dieses Blender",
    "This Blender": "Dieses Blender",
    "Run the engine of this Blender's extension": "Die Engine der Erweiterung dieses Blenders verwenden",
    "Copy Survey Command": "Befehl der Vermessung kopieren",
    "Copy the command that trains the survey with the Python of the engine, for a terminal of any machine": (
        "Den Befehl kopieren, der die Vermessung mit dem Python der Engine trainiert, für Terminals aller Rechner"
    ),
    "Merge Survey": "Vermessung zusammenfügen",
    "Merge Finished Blocks": "Fertige Blöcke zusammenfügen",
    "Finished Blocks Only": "Nur fertige Blöcke",
    "Leave out the blocks that are not finished; their places stay empty": (
        "Die Blöcke auslassen, die nicht fertig sind; ihre Plätze bleiben leer"
    ),
    "Merge the trained blocks of the survey into tiles of several levels of detail, and open it": (
        "Die trainierten Blöcke zu Kacheln in mehreren Detailstufen zusammenfügen und das Ergebnis öffnen"
    ),
    "Open Survey": "Vermessung öffnen",
    "Open a merged survey: the finest level of detail that fits the number of splats, its water and its colors": (
        "Eine zusammengefügte Vermessung öffnen: die feinste Detailstufe, die in die Zahl der Splats passt, mit Wasser "
        "und Farben"
    ),
    "SWAG Survey (folder)": "SWAG-Vermessung (Ordner)",
    "Detail": "Detail",
    "Largest number of splats of the survey that are loaded at a time": (
        "Größte Zahl der Splats der Vermessung, die gleichzeitig geladen sind"
    ),
    "Object in whose bounds Load Box loads the finest tiles; empty: the crop box of the splats": (
        "Objekt, in dessen Grenzen Kasten laden die feinsten Kacheln lädt; leer: der Ausschnitt der Splats"
    ),
    "Select the splats of a survey first": "Zuerst die Splats einer Vermessung auswählen",
    "Box Object": "Kasten-Objekt",
    "Load View": "Ansicht laden",
    "Load finer tiles for what the 3D viewport shows, and the coarsest elsewhere": (
        "Feinere Kacheln für das laden, was die 3D-Ansicht zeigt, und anderswo die gröbsten"
    ),
    "Load Box": "Kasten laden",
    "Load the finest tiles in the bounds of the chosen box, and the coarsest elsewhere": (
        "Die feinsten Kacheln in den Grenzen des gewählten Kastens laden, und anderswo die gröbsten"
    ),
    "Load Overview": "Überblick laden",
    "Load the finest level of detail that fits the number of splats for the whole survey, as when it was opened": (
        "Für die ganze Vermessung die feinste Detailstufe laden, die in die Zahl der Splats passt, wie beim Öffnen"
    ),
}


def table(words: dict[str, str]) -> dict[tuple[str, str], str]:
    """The table in Blender's format: texts of operators have another context than all others.

    Blender's own table goes first; in the context WORDS it has none.
    """
    return {(context, english): own for english, own in words.items() for context in ("*", "Operator", WORDS)}


def register() -> None:
    """Register the translations with Blender."""
    bpy.app.translations.register(EXTENSION, {"de_DE": table(GERMAN)})


def unregister() -> None:
    """Undo `register`."""
    bpy.app.translations.unregister(EXTENSION)
