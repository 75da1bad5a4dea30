"""The interface in other languages. What is missing from a table stays English; sentences of the engine always do.

Blender looks up labels, tooltips and names of properties by themselves: a language is a table of English and own words.
"""

import bpy

from . import EXTENSION

GERMAN = {
    "Scene": "Szene",
    "Photographs": "Fotos",
    "Photographs with COLMAP model": "Fotos mit COLMAP-Modell",
    "Check": "Prüfen",
    "Check Photographs": "Fotos prüfen",
    "Import": "Importieren",
    "Import COLMAP Scene": "COLMAP-Szene importieren",
    "Effects": "Effekte",
    "Plan": "Planen",
    "Plan Again": "Neu planen",
    "Plan Effects": "Effekte planen",
    "Follow Plan": "Plan folgen",
    "On": "Ein",
    "Off": "Aus",
    "Train": "Trainieren",
    "Continue": "Fortsetzen",
    "Pause": "Anhalten",
    "Go On": "Weiter",
    "Pause or Go On": "Anhalten oder weiter",
    "Cancel": "Abbrechen",
    "Show Log": "Protokoll zeigen",
    "More": "Mehr",
    "Method": "Verfahren",
    "Quality": "Güte",
    "Time Budget": "Zeitrahmen",
    "Stop When Flat": "Enden, wenn nichts mehr kommt",
    "Iterations": "Schritte",
    "Width": "Breite",
    "Max Gaussians": "Höchstzahl der Gaußglocken",
    "Water": "Wasser",
    "Metres per Unit": "Meter je Einheit",
    "SH Degree": "SH-Grad",
    "Result": "Ergebnis",
    "Set Up Render": "Rendern vorbereiten",
    "Open Splat File": "Splat-Datei öffnen",
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
    "Choose the folder first.": "Zuerst den Ordner wählen.",
    "0 keeps colours that do not change with the view: the smallest file": (
        "0 behält Farben, die nicht vom Blick abhängen: die kleinste Datei"
    ),
    "A Python that has the engine's packages; left empty: the environment of Install Engine": (
        "Ein Python mit den Paketen des Rechenkerns; leer: die Umgebung von „Rechenkern einrichten“"
    ),
    (
        "Address of a further package index, for another build of torch than the usual one: PyTorch's own has "
        "builds for processors alone and for each version of CUDA (pytorch.org, Get Started)"
    ): (
        "Adresse eines weiteren Paketverzeichnisses, für eine andere Fassung von torch als die übliche: Das von "
        "PyTorch hat Fassungen nur für Prozessoren und für jede Version von CUDA (pytorch.org, Get Started)"
    ),
    "All splat objects that can be seen in the viewport": "Alle Splat-Objekte, die in der Ansicht zu sehen sind",
    "As Trained": "Wie trainiert",
    "As splat viewers show the file: a PLY has its y axis down, a GLB its y axis up": (
        "Wie Splat-Betrachter die Datei zeigen: Im PLY zeigt die y-Achse nach unten, im GLB nach oben"
    ),
    "Axes": "Achsen",
    "Backend": "Rechenweg",
    "Between the two, in metres": "Zwischen den beiden, in Metern",
    (
        "Blend display values under the view transform Raw: the engine's own picture, for comparing with "
        "photographs; other objects in the picture look wrong. Off: blend light, right beside other objects"
    ): (
        "Anzeigewerte mischen, unter der Ansichtstransformation Raw: das Bild des Rechenkerns selbst, zum "
        "Vergleich mit Fotos; andere Objekte im Bild sehen falsch aus. Aus: Licht mischen, richtig neben anderen "
        "Objekten"
    ),
    "Blender's up is up in other programs: y down in a PLY, y up in a GLB": (
        "Was in Blender oben ist, ist es auch in anderen Programmen: y nach unten im PLY, nach oben im GLB"
    ),
    "Bring in the cameras, the photographs and the points of a COLMAP reconstruction": (
        "Kameras, Fotos und Punkte einer COLMAP-Rekonstruktion holen"
    ),
    "Bring the splats of the other selected objects into the active one": (
        "Die Splats der anderen gewählten Objekte in das aktive holen"
    ),
    "By": "Nach",
    "COLMAP Scene (folder)": "COLMAP-Szene (Ordner)",
    "Cameras": "Kameras",
    "Choice": "Wahl",
    "Click two points of the splats whose distance you know; the scene is then scaled to metres": (
        "Zwei Punkte der Splats anklicken, deren Abstand bekannt ist; dann wird die Szene auf Meter gebracht"
    ),
    "Colour": "Farbe",
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
    "Drawn by the graphics card; of two splat objects one is wholly before the other": (
        "Gezeichnet von der Grafikkarte; von zwei Splat-Objekten steht eins ganz vor dem anderen"
    ),
    "Effect": "Effekt",
    "Either name a Python that has the packages of requirements.txt:": (
        "Entweder ein Python nennen, das die Pakete von requirements.txt hat:"
    ),
    "Engine": "Renderer",
    "Every splat is in its depth among other objects, and splats of other objects": (
        "Jeder Splat steht in seiner Tiefe zwischen anderen Objekten und deren Splats"
    ),
    "Evidence": "Beleg",
    "Export Gaussian Splats": "Gauß-Splats exportieren",
    "Extend": "Erweitern",
    "Fetch Networks": "Netze holen",
    "Find splats by words: writes swag:similarity and selects what is above the threshold": (
        "Splats nach Worten finden: schreibt swag:similarity und wählt, was über der Schwelle liegt"
    ),
    "Folder": "Ordner",
    "Folder of the masks": "Ordner der Masken",
    "Folder of the run that the names are from": "Ordner des Laufs, aus dem die Namen sind",
    "Folder of the run; left empty: that of the splats": "Ordner des Laufs; leer: der der Splats",
    "Folder that the training writes to; left empty: the folder swag_run beside the COLMAP model": (
        "Ordner, in den das Training schreibt; leer: der Ordner swag_run neben dem COLMAP-Modell"
    ),
    "Folder with the photographs and their COLMAP model": "Ordner mit den Fotos und ihrem COLMAP-Modell",
    "Follow the plan in every line again": "In jeder Zeile wieder dem Plan folgen",
    "Forecast": "Vorhersagen",
    "Further Properties": "Weitere Eigenschaften",
    "Gaussian Splats": "Gauß-Splats",
    "Gaussians": "Gaußglocken",
    "Get networks that are not on this machine from their authors": (
        "Netze, die auf diesem Rechner fehlen, bei ihren Urhebern holen"
    ),
    ("Give every splat of the run a label: by your masks, by words, or by what stands out; Escape stops"): (
        "Jedem Splat des Laufs ein Etikett geben: nach eigenen Masken, nach Worten oder nach dem, was "
        "hervorsticht; Escape bricht ab"
    ),
    "Go on with the run in the run folder where it stopped": (
        "Den Lauf im Ordner des Laufs fortsetzen, wo er stehen blieb"
    ),
    "Hold the training where it is, or let a held one go on; its result is the same as without": (
        "Das Training anhalten oder ein angehaltenes fortsetzen; das Ergebnis ist dasselbe wie ohne"
    ),
    "How long the last run took": "Wie lange der letzte Lauf dauerte",
    "How much of the fitted water is shown: 0 none, 1 as photographed; it can be animated": (
        "Wie viel des angepassten Wassers gezeigt wird: 0 keins, 1 wie fotografiert; es lässt sich animieren"
    ),
    (
        "How much water the colours show, from 0 (taken away) to 1, as each splat looked from where it was "
        "photographed; from elsewhere it is not right, and the open water behind the splats is not in the file"
    ): (
        "Wie viel Wasser die Farben zeigen, von 0 (entfernt) bis 1, so wie jeder Splat von seinen Fotos aus "
        "aussah; von anderswo stimmt es nicht, und das offene Wasser hinter den Splats ist nicht in der Datei"
    ),
    "Import Gaussian Splats": "Gauß-Splats importieren",
    "In the Scene": "In der Szene",
    (
        "Install from wheels in this folder, without internet; elsewhere, pip download -r requirements.txt -c "
        "constraints.txt fills it"
    ): (
        "Aus Wheels in diesem Ordner einrichten, ohne Internet; anderswo füllt ihn pip download -r "
        "requirements.txt -c constraints.txt"
    ),
    "Installing needs online access (Preferences > System > Network) or a folder of wheels.": (
        "Das Einrichten braucht Online-Zugriff (Einstellungen > System > Netzwerk) oder einen Ordner mit Wheels."
    ),
    "Interrupted": "Abgebrochen",
    "Isolate": "Freistellen",
    "Keep as Mask": "Als Maske behalten",
    "Keep labels and other properties of the splats": "Etiketten und andere Eigenschaften der Splats behalten",
    "Keep the selection as an attribute mask:NAME, for geometry nodes": (
        "Die Auswahl als Attribut mask:NAME behalten, für Geometrieknoten"
    ),
    "Label": "Etikettieren",
    "Least Opacity": "Kleinste Deckkraft",
    "Leave it out whatever the photographs say": "Weglassen, was auch die Fotos sagen",
    "Length of one Blender unit in metres; the file is in metres": (
        "Länge einer Blender-Einheit in Metern; die Datei ist in Metern"
    ),
    "Less takes less memory: 0 keeps colours that do not change with the view": (
        "Weniger braucht weniger Speicher: 0 behält Farben, die nicht vom Blick abhängen"
    ),
    "Let the selected objects be seen through the water of the splats, by nodes in their materials": (
        "Die gewählten Objekte durch das Wasser der Splats sehen lassen, durch Knoten in ihren Materialien"
    ),
    "List the labels of the splats, with the names of the run they are from": (
        "Die Etiketten der Splats auflisten, mit den Namen ihres Laufs"
    ),
    "Look Up Size of Engine": "Größe des Rechenkerns nachsehen",
    "Look at the photographs and list which effects they call for, why, and what each would cost": (
        "Die Fotos ansehen und auflisten, welche Effekte sie verlangen, warum, und was jeder kosten würde"
    ),
    "Make Labels": "Etiketten machen",
    "Mask": "Maske",
    "Masks": "Masken",
    "Merge": "Vereinen",
    "Merge Splats": "Splats vereinen",
    "Milliseconds that the effect adds to an iteration here": (
        "Millisekunden, die der Effekt hier zu einem Schritt hinzufügt"
    ),
    "Mix the colour of its label into each splat": "Jedem Splat die Farbe seines Etiketts beimischen",
    "Move the selected splats to an object of their own": "Die gewählten Splats in ein eigenes Objekt verschieben",
    "Name": "Name",
    "Networks that find what you name in the photographs": "Netze, die in den Fotos finden, was man nennt",
    "Node Groups as Assets": "Knotengruppen als Assets",
    "Objects": "Objekte",
    "Of Selected": "Der Auswahl",
    "Of the Scene": "Der Szene",
    "Of the mask; left empty: what was searched": "Der Maske; leer: was gesucht wurde",
    "Only splats inside the box around this object; an empty counts as its cube": (
        "Nur Splats im Quader um dieses Objekt; ein Leerobjekt zählt als sein Würfel"
    ),
    "Only splats of at least this opacity": "Nur Splats von mindestens dieser Deckkraft",
    "Only splats with these labels: names or numbers with commas; empty for all": (
        "Nur Splats mit diesen Etiketten: Namen oder Nummern mit Kommas; leer für alle"
    ),
    "Open Gaussian splats from PLY or GLB files": "Gauß-Splats aus PLY- oder GLB-Dateien öffnen",
    "Open the engine's log of the last job in a text editor": (
        "Das Protokoll des Rechenkerns vom letzten Auftrag in einem Texteditor öffnen"
    ),
    "Open water, what stands out, and the rest; needs nothing": (
        "Offenes Wasser, was hervorsticht, und der Rest; braucht nichts"
    ),
    "Other photographs have been chosen since": "Seither wurden andere Fotos gewählt",
    "PLY in Blender's own axes; a GLB always has y up": "PLY in Blenders eigenen Achsen; ein GLB hat y immer oben",
    "PLY in the COLMAP frame of the scene that the splats hang from": (
        "PLY im COLMAP-System der Szene, an der die Splats hängen"
    ),
    "PLY with y up, for programs that show a PLY as it is; a GLB always has y up": (
        "PLY mit y oben, für Programme, die ein PLY zeigen, wie es ist; ein GLB hat y immer oben"
    ),
    "PSNR on photographs that the training never saw, in dB": "PSNR an Fotos, die das Training nie sah, in dB",
    "Pick Two Points": "Zwei Punkte wählen",
    "Place": "Ort",
    "Put into the Water": "Ins Wasser setzen",
    "Python": "Python",
    "Read Labels": "Etiketten lesen",
    "Remove": "Entfernen",
    "Run": "Lauf",
    "SSIM on photographs that the training never saw": "SSIM an Fotos, die das Training nie sah",
    "Save splat objects as one PLY or GLB file, their transforms and modifiers applied": (
        "Splat-Objekte als eine PLY- oder GLB-Datei speichern, Transformationen und Modifikatoren angewandt"
    ),
    "Say what the engine's Python has: packages with versions, processor, graphics card": (
        "Sagen, was das Python des Rechenkerns hat: Pakete mit Versionen, Prozessor, Grafikkarte"
    ),
    "Say what the folder holds: photographs, cameras, points, and what is wrong with them": (
        "Sagen, was der Ordner enthält: Fotos, Kameras, Punkte, und was an ihnen nicht stimmt"
    ),
    ("Say which build of torch the engine would get and how much would be downloaded, without downloading it"): (
        "Sagen, welche Fassung von torch der Rechenkern bekäme und wie viel zu laden wäre, ohne es zu laden"
    ),
    ("Scale the scene to metres by the distance between two selected objects, such as cameras, or two points"): (
        "Die Szene auf Meter bringen, nach dem Abstand zweier gewählter Objekte, etwa Kameras, oder zweier Punkte"
    ),
    "Search": "Suchen",
    "Search Splats": "Splats suchen",
    "Seconds": "Sekunden",
    "Seed": "Startwert",
    "Select Label": "Etikett wählen",
    "Select an object with splats first.": "Zuerst ein Objekt mit Splats wählen.",
    "Select the splats of this label; with Shift beside what is selected": (
        "Die Splats dieses Etiketts wählen; mit Umschalt zusätzlich zum Gewählten"
    ),
    "Selected": "Gewählte",
    "Separate": "Trennen",
    "Separate Splats": "Splats trennen",
    "Set Scale": "Maßstab setzen",
    ("Set up Cycles or EEVEE for splats: all layers, true colours, the trained background, the picture's size"): (
        "Cycles oder EEVEE für Splats vorbereiten: alle Schichten, wahre Farben, der trainierte Hintergrund, die "
        "Bildgröße"
    ),
    "Show All": "Alle zeigen",
    "Show Colours": "Farben zeigen",
    "Show all labels": "Alle Etiketten zeigen",
    "Show the splats with this label": "Die Splats mit diesem Etikett zeigen",
    "Show this label alone; all again on a second click": (
        "Dieses Etikett allein zeigen; beim zweiten Klick wieder alle"
    ),
    "Simulate it whatever the photographs say": "Simulieren, was auch die Fotos sagen",
    "Splats of the last run": "Splats des letzten Laufs",
    "Splats that are more similar than this to what was searched are selected": (
        "Splats, die dem Gesuchten ähnlicher sind als dies, werden gewählt"
    ),
    "Splats with this label": "Splats mit diesem Etikett",
    "Stop what is running and keep what exists so far": "Anhalten, was läuft, und behalten, was es schon gibt",
    "Take Out": "Herausnehmen",
    "Take Out of the Water": "Aus dem Wasser nehmen",
    "Take the asset library away, from the disk too": "Die Asset-Bibliothek entfernen, auch von der Platte",
    "Take the water's nodes out of the materials again": "Die Knoten des Wassers wieder aus den Materialien nehmen",
    "The figures behind it, each beside its threshold": "Die Zahlen dahinter, jede neben ihrer Schwelle",
    "The last run was stopped before its end": "Der letzte Lauf wurde vor seinem Ende abgebrochen",
    "The photographs tell which effects training should simulate.": (
        "Die Fotos sagen, welche Effekte das Training simulieren soll."
    ),
    "The scene's own masks, where it has some in its folder labels, else what stands out": (
        "Die Masken der Szene, wo sie welche im Ordner labels hat, sonst was hervorsticht"
    ),
    "The selected splat objects": "Die gewählten Splat-Objekte",
    "The splats have no fitted water.": "Die Splats haben kein angepasstes Wasser.",
    "The value of swag:label": "Der Wert von swag:label",
    "This plan is of other photographs: plan again.": "Dieser Plan ist von anderen Fotos: neu planen.",
    "Threshold": "Schwelle",
    "Train first, or open a splat file below.": "Zuerst trainieren, oder unten eine Splat-Datei öffnen.",
    ("Train for some seconds and say what each quality would take on this machine: time, PSNR, memory; Escape stops"): (
        "Einige Sekunden trainieren und sagen, was jede Güte auf diesem Rechner bräuchte: Zeit, PSNR, Speicher; "
        "Escape bricht ab"
    ),
    "Training runs in a Python of its own; opening, showing and exporting splats needs none.": (
        "Das Training läuft in einem eigenen Python; Öffnen, Zeigen und Exportieren von Splats braucht keins."
    ),
    "Turn the photographs into 3D Gaussians; Escape stops and keeps what exists": (
        "Aus den Fotos 3D-Gaußglocken machen; Escape bricht ab und behält, was es schon gibt"
    ),
    "Upright": "Aufrecht",
    "Visible": "Sichtbar",
    "What Stands Out": "Was hervorsticht",
    "What renders": "Was rendert",
    "What the folder of photographs holds, in words": "Was der Ordner der Fotos enthält, in Worten",
    "What the last run found of the water": "Was der letzte Lauf vom Wasser fand",
    "What the photographs say: on, off or unknown": "Was die Fotos sagen: ein, aus oder unbekannt",
    "What the photographs say; what they cannot tell stays off": (
        "Was die Fotos sagen; was sie nicht sagen können, bleibt aus"
    ),
    "What the qualities would take, as JSON, with what was asked": "Was jede Güte bräuchte, als JSON, mit der Frage",
    "What the splats are labelled by": "Wonach die Splats etikettiert werden",
    "What to label, as in coral, wreck, open water": "Was zu etikettieren ist, wie in coral, wreck, open water",
    "What to look for, such as coral": "Was zu suchen ist, etwa coral",
    "What to look for; left empty: what stands in the panel": "Was zu suchen ist; leer: was im Feld steht",
    "Where the file's splats were trained, in the imported scene they belong to": (
        "Wo die Splats der Datei trainiert wurden, in der importierten Szene, zu der sie gehören"
    ),
    "Whether training simulates this effect": "Ob das Training diesen Effekt simuliert",
    "Something is running: wait for its end, or cancel it": "Etwas läuft: sein Ende abwarten oder abbrechen",
    "No environment has been made": "Es gibt keine Umgebung",
    "Select objects with materials, in a scene whose splats have a water": (
        "Objekte mit Materialien auswählen, in einer Szene, deren Splats ein Wasser haben"
    ),
    "No job has written a log yet": "Noch hat nichts ein Protokoll geschrieben",
    "There is no imported scene and no splats; or several, and none of them is selected": (
        "Es gibt weder importierte Szene noch Splats; oder mehrere, und nichts davon ist ausgewählt"
    ),
    "Nothing differs from the plan": "Nichts weicht vom Plan ab",
    "It is stopping already": "Es hält schon an",
    "No training is running": "Es läuft kein Training",
    "There are no splats in the scene": "In der Szene sind keine Splats",
    "Select an object with splats first": "Zuerst ein Objekt mit Splats auswählen",
    "Words": "Worte",
    ("Write the node groups of splats and water to a library, so that the asset browser has them in every file"): (
        "Die Knotengruppen von Splats und Wasser in eine Bibliothek schreiben, damit der Asset-Browser sie in "
        "jeder Datei hat"
    ),
    (
        "Write the photographs' cameras too, without lens distortion: in a GLB, and beside the file as a COLMAP "
        "text model, transforms.json and, where the run has a water, water.json"
    ): (
        "Auch die Kameras der Fotos schreiben, ohne Verzeichnung: im GLB, und neben der Datei als COLMAP-"
        "Textmodell, transforms.json und, wo der Lauf ein Wasser hat, water.json"
    ),
    "Y Up": "Y oben",
    "Your own mask images: one folder a label, with a picture for each photograph": (
        "Eigene Maskenbilder: ein Ordner je Etikett, mit einem Bild für jedes Foto"
    ),
    "Z Up": "Z oben",
    "or make one, into the extension's own folder; half a gigabyte, with CUDA three:": (
        "oder eins machen, im Ordner der Erweiterung; ein halbes Gigabyte, mit CUDA drei:"
    ),
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
    (
        "Time that the whole run may take, such as 90s, 10m or 1h30m; the size is then chosen by measuring this "
        "machine, in place of a preset"
    ): (
        "Zeit, die der ganze Lauf brauchen darf, wie 90s, 10m oder 1h30m; die Größe wird dann durch Messen auf "
        "diesem Rechner gewählt statt nach der Güte"
    ),
    "Number of optimisation steps, each on one image; 0: as many as the preset has": (
        "Zahl der Optimierungsschritte, jeder mit einem Bild; 0: so viele, wie die Güte vorsieht"
    ),
    "Width in pixels of the training images; smaller images keep their size; 0: as the preset has it": (
        "Breite der Trainingsbilder in Pixeln; kleinere Bilder behalten ihre Größe; 0: wie es die Güte vorsieht"
    ),
    "Largest number of Gaussians that densification may reach; 0: as many as the preset has": (
        "Größte Zahl an Gaußglocken, bis zu der verdichtet wird; 0: so viele, wie die Güte vorsieht"
    ),
    "End early when a fifth of the run has improved the validation PSNR by less than 0.05 dB": (
        "Früher enden, wenn ein Fünftel des Laufs das PSNR der Prüffotos um weniger als 0,05 dB verbessert hat"
    ),
    "Effects and parts of the method to switch by hand, such as water=off,lamp=on (docs/recipes.md lists them)": (
        "Effekte und Teile des Verfahrens, die von Hand geschaltet werden, wie water=off,lamp=on (docs/recipes.md"
        " listet sie auf)"
    ),
    "What to label while training with semantics=on, such as coral, wreck, open water; needs pretrained networks": (
        "Was beim Training mit semantics=on zu etikettieren ist, wie coral, wreck, open water; braucht "
        "vortrainierte Netze"
    ),
    (
        "Folder of mask images to label by instead of words; without both, masks in the scene's folder labels are"
        " used, or else saliency"
    ): (
        "Ordner mit Maskenbildern statt Worten; ohne beides gelten Masken im Ordner labels der Szene, sonst die "
        "Auffälligkeit"
    ),
    (
        "Initial attenuation of the water: auto fits it to the photos; or a Jerlov type (I IA IB II III 1C 3C 5C "
        "7C 9C), or three numbers per metre for red, green and blue, such as 0.3,0.1,0.06"
    ): (
        "Anfangswert der Dämpfung des Wassers: auto bestimmt ihn aus den Fotos; oder ein Jerlov-Typ (I IA IB II "
        "III 1C 3C 5C 7C 9C), oder drei Zahlen je Meter für Rot, Grün und Blau, wie 0.3,0.1,0.06"
    ),
    "Length in metres of one unit of the scene's coordinates; 0: unknown": (
        "Länge einer Einheit der Szenenkoordinaten in Metern; 0: unbekannt"
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
    "PyTorch without native code: slow, the reference for the others": (
        "PyTorch ohne Maschinencode: langsam, der Maßstab für die anderen"
    ),
}


def table(words: dict[str, str]) -> dict[tuple[str, str], str]:
    """As Blender takes it: buttons of operators have a context of their own."""
    return {(context, english): own for english, own in words.items() for context in ("*", "Operator")}


def register() -> None:
    bpy.app.translations.register(EXTENSION, {"de_DE": table(GERMAN)})


def unregister() -> None:
    bpy.app.translations.unregister(EXTENSION)
