"""The chances with which the slots of `context_model` and `number_model` begin, learned from
simulated worlds; written by scripts/context_chances.py. A byte for each slot: the probability of
a 0 in 1/256; 0: unknown."""

CHANCES = """
c-rk62T)Yk_N*<U<`Wwd<*SL&ps1+d#72lQ#zeuWh#Hg;3!;GZy0k}IcG*VRWm$HYZ7jWaP%t1O#2OVf=9@$_$@pVpie-Lcl=t7euPiWNW|E)
rXTEo4=bU%X?f3M%7b;@+08u#ef5d?<_B9k5-}ntv1)S;kS^CR$6q?%ci<!<zWa(i27=c%PKBc}(B<-B8&O8utjzJO@0zqS<e&sZu0M0Ez6eL
8$*h`YfKXAHWIG3{>11|h+-?)3dzi^-;|8p;wccCC3^VpeUESK|qh0ra-Yg^?26~%Z|ZVAANIJ~Ji6`*!Mo{xD0<Y@2&p$R}0jAuj!1DrSEZD
%zAnJ4f-LnXk4LwLt!KESbcc(sokfWn9elr$6ld~rp15P(dIzwn$GAmJ)L(((v^WEVbpv?oByEPUGVWdL5?xWzD{-g7ZNb=aFk`?Ox`i8=uJx
A>^({{+Yl?44~{NQ`TVkK;@v+I^0XnR*@I;8c9hh`9hC<>IEYB!GZq+}1J{rb+=E!_PeYl|H)6nrjGEtEx)K(|eVmZxo!r^N6PBR(*m{nWp08
DRl0{&%(KuIsC2MOoVzwW%9ow>BEWN2w8P6b2lyp2%V8#f}NwQCV19AV8-Vco<gWxme=?bU1#ZD@qp={pzB1aOrdM~H(fW@$#|ckW9n{%N-~s
%cj>z4*W}!L%+RGDA~Zp&thrCujaeRlhoQ$wTM?R^BFbjQpI3PKHp6MkuCoZO6_uv?GVGSn{RPus(%6Mil}2|ogRYzGUv-<=U$U_cp?X6}X*F
Fp-n-&9b39x{BZ69aQyEidwJrS;+h5s2oqv#0e3YSY)!$&~DH#-95>cAT)J?~<Uo&F~%a0(Ko>X8W;m&*xNPBKETZPhZIuPtKDX)`oSqKM`zd
X)t4^Ff-QBduV;J5<-Hk;3}*XyaJwjxn<BAArLf%Df&+5V>+jw9F{Dn`)GmII<|^$!{P*<+Om7SrFOLy7Zszrt(<_6vVNFq(IQ75AC$$*dwUq
_rZb^3E<`>L%K~!LF|)Jq*F3eQxOZcqst4B<%9wF^w`cOXCTVYci`A)pZKye?`H$u>dP~E7%4Z3hLT2L@Esl*F*t0J8u#)4U9Qr)F4`lWoYsM
wh?sK1#>op(JTB2OOL7|V2j*4tDdKXrP~1hVPiGLAqxg6k?=>02?KZ_8Jg}y&{Hp)_kV=m_mS@?IG<SmHfb^2Kv<nk@ozRykK{a#I3IUU-p`E
uH0WDM*rq<_q96old<Y@`)7JX>F*huYu2GY63MU1=5Cx-DgnYhWweEv<W`-6>V^<Ree|FgyP3-A}dH)qRXg>Owg2BZ8f+FK?GYpoeP@(<h@Z)
vOgjr}x1lSdjtz`PAXfIImL4V(czjkp7TXZfcQ~d?YPbHLG^G#SP2_2)>oZBNUxXjS?N2@6PqYOdx#l*>MNoCa&<P8{qb*#<J4ZDK)r8nvRmB
qQ22v{S^i&oUPKv<Z=iS1kVB^tk{<x6HfPHHfbDod^u>L5`NlfG=N@AV6eeamR0^v?lRISH2oJe+DX-Z6EE{YhZL&wsaf+<{Tu;EKSYJx|K1r
W_g}8hX_4o<Hcd{VdbI6)OL$=lco#f0y-yeh4Tx%b)fPEr0aEj3!*H@h`d6F)g?W=~|>`Vnh<YjG!k2jGD9}p!^<1KM-PSG7>O!k2pO^Qu>!a
pFOasU79j9{e7^#iE+(5c?RoGUr73D@}c|Bh&)_o?-rub)8FN-rN|OViz|_PGn2bJbBSxm=_+~+yu1!%fWr;>v4wC1#wRBS&0O_EMKI%Eby5b
z=lnJ5{=lczYQ}t*8uOI>RyYdQbWO5de<hr9Hy}H;8R^%sfE>b(W`L!Bcb)Z|H@|OYItR9VhV*hoOiM95D^I)lB>RLXx0vO(l6Lxa=P9@`Hdc
|`YWBa%XupE-o!=Ai)RI%?@$v_ZAI?n)iU{YmF*6iu^NNt47MoR6(?E<L7Uy>;IKGi_Ftr7hUC0jPM(Pp?pJIO6p)5yd&!z{A|Dwo24sbLk5(
|jQl-yL_UZ?ebxpc75X5eW_4_IU@5*n~lSiUPabftrbuZlM0RS61Y;T!7qWBDiRz$PoO&~CnmSV`-v)N)nXMN*EMR4&DYmwW#ii#*lxc9K(Zb
fk&>9;h>>6Thq{^j|{!Ha~$LnP}VN7apFWzeIgEWY?6C{E;QjDAHG{VRhoNlTLg6m2D>}x-6#xg@w7X{>ka>d0>6mv1755e~kPN?Z4;^RpffI
w3$3zU=}pTz4()>$Km}kRM-PetsTvzhjqEW8@eF}mcrr|hqXKQ_|nm2u;j``vcGbR0h*x!tn=Ua(%R1DuuMn!WhzXVCnpY}EGA1-VbTHV?yma
-=ev^ducj@3ed;q#`+a3sIB{pk*zgx}duT|1J178r8(_$Y$eYxWPZ<A&RDaowMSCQS{!C5JMsce!8jB4iLb)+XuEq(Aw&XJjf(&&k3co^gC4v
;fQd@*Nn#N9jOLvb}u;O@r1BnU}_~JBuJ3OB#7EfGY@7+l2^<Zw+5z+*B_=gDeSS5@KKcpXHW#?7<5gi}JBp7cIFwG|k6B)%YGGcSS#gy0LuY
XJDhoX3SWat$UB+|#_>R~pSe|g4TPpvHclgED{Xls$x%I;4;W%7U03&@!b5?n+Y&syj!p0&31;~s|prB@LY>8b44?0s%In<9+rIyysSEN?6z9
fSnET2fB9n!|(Fb&mMk^v_zosRTn*h7e8VtMaHl1qK)w>QXylrt3{Q{DYvVLKLi~`UR<v5zxld!?5b0tX<|w2_a8g)m=g8PlHUWsm0QsG01O}
8SoHBOd9d}*H3BwxquIQY2y6V-!c^kJ(u<kzF&h!;I!yH%~1X4lRWwkHsts=@Ob3BnQtZc3?AMP_7Ug2V!cHCFUFrWdM`$PDx@DE=eLE&!|hl
2vH2s2XzADAf>__OO~FIXKLvU@mJ7G<`H`7j6NM7YTsdF`NPcn79Q$>ACjXxi9gP+kfpNW#%gFh0&fM36<ctN<V1dX5$I9I$q_6Zc^bVV{@SS
SLzfRqoLkFANQF?qb(cfz6#-#6<{7;xrhUBa^E!bcHh{2>jJx@rPtof65OiD<aZ&7_NyMkIe&#0xpXSr26Zsr=;_ARph{h#+$!|p!Z(K=v!%M
EAOEn0A(nXTaW57v|8WZs#jrx|k&HH}mz>Nsu47lcbUxJyiIekrr^7G-CF;)8j?#rvHD`K;SoW*Tt+SgXSVCn1}E^VU%LIcGi}Mbwco>E0q^1
IwPKvU&vNiZrw<o2cSdYeF;Y82%_IsY3cuxYG;BqZ%vVy}#0jcZcQfRw}<Q12v_;-K*bxc?Y+KiSUxtdh~#xm70w8{{#AG8liveCQWu4if;D@
#~((>=a`Ah-_;I5-$c-@R;;QUs{c}g{-TY;PR;L}e+=}3<&0VD{R0P6Kp40Z^1EsECO3vFu>pzD-SBwWu9Z&S?L&;elhALA-`F2Gw0_5jO?hR
WbF7%s5NTS>Jq>YN%LPzp!H%bV|MqgZPG~yFe%~BGf6)aXWbf}Ef4G3q5i3@?4;g=ENdwZ)n5~13eqUnp;5$W$GW{tt_vi-NADKLy*C%K_IZ*
!-x4qka==E)m7e(v3>KOM1I!~kY2sF1)4!LV=+QE{ZPWFASyN%)mM$K&HXQXPbvg!psywN`naSc%<$vd-It#q88shs|vC?Iug1N-<d$U1|bio
~MwB68Hp6~rDtDEyImUy)=VN16U~k*bXRcK`<`-=H~eJ#30;LMin^Xm{0^b^}Ht`iO-QEIoxr-Tkm|%Bpe9=_%+P<cv6v?y~!T^f86jvl%6VU
j38Vo?NBvgrHCV*t={17vD{xN!8|<uJ8Q#VDtB>eDoXiD}&K{pS-_GbKc{Y-lsHtnoOwfAketv6oVv_dW*Jwn_GU9o;Wur=O~G4ggN;&Vye=?
FZTkY-zyAlh#S)d#ezn<ZlCz*H8%fONHKs>-^tqCTW8H@nK_6ru*B;k+rV2%c`~YObLQ-m;?G!I{W%4X^o=3bxBbfYH&PAcqK;}X^A9S|Sy&}
7W|_XNe)N%}XEJO}x6|~a&pwO~2*VGe_e;)*krtDt&-I|s-pL~%mPQpYC7%3`#3+mBrdT;My_M}=G|C_JzWV83qGjY0_=ocw{mttiIo@`XJ;k
*f!xL$5Zcu*gTmA#XM*E-
"""
OF_COARSE = """
c-rk+2~ZSA6#avscpJrdB&A|JBc&u_)JjsOG-^bR;(?`6&}a!NK@Q_0i;T)4yCBE9$g;w+vfSc=xC@8~B8rIdzzSkaVig9W#``Moo%Bx6^uSs
Ws|;$)zN)GJyWjNRneN{`|99`9GJQNCSVum61{_wL$7)^ysRAp%=R|j^!?Iv6sRF9YWro*n#aMOQaS>Ofi_cQ$YWG11bsPd{U+^3#dQO#|2g@
s);$Wi)de+g*E$R%k&7_u&1b?s{(ZBBY0}5nx+4S+tAXzPoSSK$oD@vecP_AZl2?~G%IZU*4H$bU`(W|xs6pNXRfGB{yY9=u#2|c`oN!x^8ty
;qzP^STu<S~+9bpNp^LwPFV^Vc%^SQ(OuOsFajplF>TJ!&05TrktQ-D-gC8m61odVpPyhOQkK03<swUE0h92of{x+iU>Xw2bLMtpM1$-C)y82
_P*oSocD|Q!x42XMMu~^mc|W?d$>QEJL48F#v(~2C)7XJx2<Ys@Mat&5!xAcQ80a0ElXClg{1y8}8gAs!Udnt^#mBapwuor(L+r$_k~Nl{W7I
jN4LT;CcT7tSa1VS^0iP)LyoO*e{V|)i*JnjNQlCHwhnKiq$0L8Nv@!UnBMtOR<`jexC3{c3vmE@-S9+@4QI(fzkDZm+7!7m;WO0Ay)`5<(^+
1@jKzCo@yZa0WFrQ6v6i<R@Oh|_1uyhxSuj<!jH?nPV~%DER&81?d{VAURlLSe}NwrUq|$v`B*0J5%?iN)x!IwVKr8!Cj6MVvt%OW9KdR*B$1
W#b14X`7v@&sHEwR@U^!t81v$5cd3gRVH;!C+yf+1k`@}t<61xW!bLGWF7La|PbPt@qiDemAcJ;M_BLWS=sA9}<wgUM>p?nlxgzcg~$onf2uq
usvO!&S-YY3mU6sxp5mS?2^3^b1fGzITAy213`6~V}7?+N{r!Kr+W_a^j?vU<`%v=*yLaxB9GQ6Eq8yv_5`bPT@FlNK4}k7#M>^Wl^Y&`P-F4
Pa=2FJBArs0H2&xp~Pwp`2mDPYnTB>m~Sa%vLP@6j%=T1eiO=uUY#RUI3lOjuXKff^IV!|3)2T+E*C?XfD+XUZFgV<#9Z{;27$k1)jo(N>Pnv
D7+g83+m92<s(es1aAGfz?B1bw7r+87uJ_FPQApp_khRwwSqmliT$-cogU6uCaxjlQHWQ7G|s{gTYCJtARxVle*#Uif>jlY-HyhUI5K!-ol~J
IkF1Yp@LHbAmC={B!P3^P+4rM?dSo-vd7q9eSLyIr#zF=69)rPu5}09z8D_k5(EAIq%)1CbpbT|ah4N(+J}=0z;`$Ate8Gf|ig4L=LH?Hz-^9
FI{gW!~0u7BE;NSKIS>O^`SkVJg&N|#Qzi|o}ty{HU$S)!*xj2Ih6zrpbo~IY=DNO8VZ}kbEFIJ!6M<_O0&l(F1PdTkY(oQlfbCS1`#NQ!FI5
JRVB(QQ&bZGgISt~0^ydTBqRmJAT;VpnyZp$O#{EGJdJ#6Y0N|FxoexI9D%&NM`*zb(F>XeN`e_a&0^&rWwOL5|y$wio7XzdQWY>}Sgd9Bg|=
XuBRqZQ2W(=dLff1sAzVn|NgpJtRr(xWKGtcFh%BOgzizTWdBA3x`uWOp9QxeR)kqW7KtU%3PpatU?RzG!v^DVHUr((tp{LCi423^UC5Pr|ry
bGjAnC+(P~J$Iy<l;chKmFRMN1^d3@#k(tXDOKeAufh?kCJzU&W59);C|M)q4<_wDMc0TH?AxHra`0@kqr9c~2n?13ruh;VrhVup{5R<8-HQ8
%eSxtUI@X)`-<tIStlZ|WX6qc_iRJJat{Kg>AB8R}x_SFO;E7dFhelb~nx_14V5ou9L^Zd#@`kV=S2k{!exGaH>>UIKYUrvEl2-dkC$n-n;0@
O9@T^ULr-l4+5o8#dMi_+n&J*S~$^b<##Q)>p;P{7v+96OS^p7^PDQ^p5AW}5nzBjr?wqW1VxCTsVo{x7=oU=KyfQ+DqJHL$Kdeq)Iees<9{p
5b7N&D_7#hB{cXoDoDDc=TN{bn|wfo<8Sa9p35t>rWLeOf(hLF^jAmhFIEK5Kg}Ibc<BM@4+XJ!FB#&F<@D!QesO4=^ksXH>t>olgokl$jSDG
t4mKwV?hr#J?>;x<Tf1=_L8QgHGF&9~c5KRdtmdz{-x|)BIf;+{Wf7v<ACfBnQ|5DR?h7Y&+&D#86bfDsn?N2|jAQGh1W)2TfZe-~Izvo=<S}
z*}YNdC?wR9o54BCtiksRlMon|33r!4~B(Rj}WeUBNrVs;jOK^bM>$d3w0BIu$YWaFczy@{rQ)mpOm!VAJj{}zlBxT0X^-UjLkhoA=%s?Ug&@
Hx4!`{0Il@
"""
OF_ATTRIBUTES = """
c-ouJ$iTqJ$oQWD4*sLiQRNH_s~;@=3zI!}`4X63%&-hhH#adb9QyDZuKPBWxe3besbgR`{S#sOJqA>u1(bJ5u9~%W%PlZ}>bx~O4qOGA+dg&
jq`DaliuDW(R%Kg`UAY5MKYitiOItwdTIbE#S|7-85U79OtAB9w&OL+BP~{AZ%NQ7*Ald&4&HkCy3=Gc@+8N%U$#-@F-TVi^e~u;(0Ib(P$^
"""
